"""HTTP routes, a module for each kind of resource, imported when an application needs them."""

from importlib import import_module

from starlette.routing import BaseRoute

PAGES = {"", "pages", "static"}
# The routers, in the order of the calls in the OpenAPI document: module, name, and the first parts of their paths. A
# module that adds routes to the router of another one has it under a name of its own.
ROUTERS = (
    ("people", "router", {"surgeons", "suture-types"}),
    ("recordings", "uploads", {"recordings", "demos"}),
    ("recordings", "router", {"recordings", "proposals"}),
    ("demos", "router", {"demos", "recordings"}),
    ("training", "router", {"trainings", "retrainings"}),
    ("tries", "router", {"tries"}),
    ("jobs", "router", {"jobs"}),
    ("policies", "router", {"policies", "policy-versions"}),
    ("plans", "router", {"plans", "reach"}),
    ("playbacks", "router", {"playbacks"}),
    ("plans", "suture_point_router", {"suture-points"}),
    ("timelines", "router", {"timelines"}),
    ("cards", "router", {"policies", "policy-versions"}),
    ("datasets", "router", {"datasets"}),
    ("comparison", "atlas_router", {"styles", "demos"}),
    ("comparison", "score_router", {"scores", "surgeons"}),
    ("operating", "router", {"healthz", "readyz", "history", "metrics"}),
    ("operating", "reference_router", {"docs"}),
    ("pages", "router", PAGES),
    *((module, "page_router", PAGES) for module in ("recordings", "timelines", "comparison")),
    ("sign_in", "sign_in_router", {"sign-in", "sign-out"}),
    ("people", "key_router", {"keys"}),
)


def routes_of(part: str | None = None) -> list[BaseRoute]:
    """Return the routes of the routers with paths that begin with a part; with None, all routes."""
    wanted = [(f"{__name__}.{module}", name) for module, name, parts in ROUTERS if part is None or part in parts]
    for module, _ in wanted:  # before their routes are taken, because some add routes to another one's router
        import_module(module)
    routers = [getattr(import_module(module), name) for module, name in wanted]
    return [route for router in {id(one): one for one in routers}.values() for route in router.routes]
