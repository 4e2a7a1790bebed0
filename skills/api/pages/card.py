"""The policy card as one file: nothing in it runs or is fetched, and it reads on a screen, at night and in print."""

from base64 import b64encode
from hashlib import sha256
from importlib import resources
from math import hypot

from markupsafe import Markup, escape

from skills.api.pages import coverage_drawing, drawing
from skills.api.pages.page import templates
from skills.library.cards import Card
from skills.style.evaluation import discretisation_rmse

STYLE = (resources.files("skills") / "api" / "pages" / "templates" / "card.css").read_text()
# By its digest, so that no other style is taken; no script, picture or address at all.
POLICY = f"default-src 'none'; style-src 'sha256-{b64encode(sha256(STYLE.encode()).digest()).decode()}'"
HEADERS = {"Content-Security-Policy": f"{POLICY}; frame-ancestors 'none'"}


def card_page(card: Card) -> str:
    """Write the page."""
    facts, partner = card.facts, card.demo.partner
    return (
        templates()
        .get_template("card.html")
        .render(
            card=facts,
            metric={one["name"]: one for one in facts["metrics"]},
            path_states=len(card.path.states),
            lost_mm=hypot(*discretisation_rmse(card.demo.tip_mm, card.path.grid, card.path.hysteresis)),
            views=Markup(drawing.views(card.demo, card.path, card.combined)),  # noqa: S704 - our own mark-up, in which names are escaped
            layers=[(name, Markup(svg)) for name, svg in coverage_drawing.layers(card.coverage, card.path)],  # noqa: S704
            block=coverage_drawing.block_of(card.path),
            pauses=bool(card.demo.pauses),
            partner=None if partner is None else partner.arm,
            style=Markup(STYLE),  # noqa: S704
            policy=POLICY,
            code=_code,
        )
    )


def _code(text: str) -> Markup:
    """Set what stands between backticks as code, and escape all."""
    parts = enumerate(text.split("`"))
    return Markup("").join(Markup("<code>{}</code>").format(part) if odd % 2 else escape(part) for odd, part in parts)
