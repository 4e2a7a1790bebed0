"""The OpenAPI document without its prose: paths, operation ids, parameters, schemas and component names.

python -m tests.openapi_shape > before.json     # in one checkout, then in another; `diff` compares them
"""

import json
import tempfile
from pathlib import Path
from typing import Any

PROSE = {"description", "summary", "title", "example", "examples"}


def shape(document: Any, named: bool = False) -> Any:
    """Return a document without its prose; `named`: its keys are names of properties or components, not keywords."""
    if isinstance(document, dict):
        if isinstance(document.get("required"), list):
            document = {**document, "required": sorted(document["required"])}  # a set: their order has no meaning
        return {
            key: shape(value, named=key in ("properties", "schemas", "responses", "headers") and not named)
            for key, value in document.items()
            if named or key not in PROSE
        }
    if isinstance(document, list):
        return [shape(one) for one in document]
    return document


def main() -> None:
    """Print the shape of this checkout's document."""
    from skills.api.app import create_app
    from skills.settings import Settings

    with tempfile.TemporaryDirectory() as folder:
        document = create_app(Settings(database_url=f"sqlite:///{Path(folder) / 'empty.sqlite'}")).openapi()
    print(json.dumps(shape(document), indent=1, sort_keys=True))


if __name__ == "__main__":
    main()
