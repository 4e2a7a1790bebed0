"""Whether a browser asks or a program: many resources are a page for people and JSON for the rest."""

from skills.errors import UnknownFormat

HTML = "text/html"
JSON = "application/json"


def wants_page(accept: str, what: str) -> bool:
    """Choose between a page and JSON: the first that the client's `Accept` names.

    Args:
        accept: The header.
        what: What is asked for, as the refusal's sentence begins.

    Raises:
        UnknownFormat: The client takes neither.
    """
    for wanted in (part.partition(";")[0].strip().lower() for part in accept.split(",")):
        if wanted in (HTML, "text/*"):
            return True
        if wanted in (JSON, "application/*", "*/*"):
            return False
    raise UnknownFormat(f"{what} is given as {JSON} or {HTML}.")
