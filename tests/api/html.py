"""Parsed pages: their tags, attributes, addresses and text."""

from html.parser import HTMLParser


class Html(HTMLParser):
    """A page's tags with their attributes, and its text without that of drawings."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self._skipped = 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._skipped += tag in ("svg", "style")

    def handle_endtag(self, tag: str) -> None:
        self._skipped -= tag in ("svg", "style")

    def handle_data(self, data: str) -> None:
        if not self._skipped:
            self.text += data + " "

    @property
    def names(self) -> list[str]:
        """The names of the tags."""
        return [tag for tag, _ in self.tags]

    @property
    def attributes(self) -> list[tuple[str, str]]:
        """The attributes of all tags, by name and value."""
        return [(name, value or "") for _, about in self.tags for name, value in about.items()]

    @property
    def addresses(self) -> list[str]:
        """The addresses to which the page refers."""
        return [value for name, value in self.attributes if name in ("href", "src", "action")]
