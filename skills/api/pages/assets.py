"""What pages load: our own scripts and style, and the script of plotly as its package brings it.

All of it is read once. Its address carries the digest of all of it, so a browser may keep a file for good and still
never mixes two versions; our scripts import each other by relative addresses and so stay in theirs.
"""

import gzip
import hashlib
from dataclasses import dataclass
from functools import cache
from importlib import resources

TYPES = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
PLOTLY = "plotly.min.js"
# The script brings maps, which no page draws, with a style for them: it is left out where an element has this id.
PLOTLY_MAP_STYLE = "ce8d464691048653ffe3a57c6c18ab566e8366f186677868cf724621a857b4fe"


@dataclass(frozen=True)
class Asset:
    """One file: its bytes, the same packed, and its media type."""

    content: bytes
    packed: bytes
    media_type: str


@cache
def assets() -> dict[str, Asset]:
    """Read them all, by name; no name of a client's is ever made a path."""
    own = resources.files("skills") / "api" / "pages" / "static"
    files = {file.name: file.read_bytes() for file in own.iterdir() if file.is_file()}
    files[PLOTLY] = (resources.files("plotly") / "package_data" / PLOTLY).read_bytes()
    return {name: _asset(name, content) for name, content in files.items() if _ending(name) in TYPES}


@cache
def build() -> str:
    """Compute the digest that is in every address."""
    seen = hashlib.sha256()
    for name, asset in sorted(assets().items()):
        seen.update(name.encode() + hashlib.sha256(asset.content).digest())
    return seen.hexdigest()[:16]


def _asset(name: str, content: bytes) -> Asset:
    return Asset(content, gzip.compress(content, compresslevel=5, mtime=0), TYPES[_ending(name)])


def _ending(name: str) -> str:
    return name[name.rfind(".") :]
