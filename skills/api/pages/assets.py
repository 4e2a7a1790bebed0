"""Static files of the pages: our scripts and styles, and those of Swagger UI from its package.

They are read once, and their URL contains a digest of all of them: a browser may cache a file permanently and never
mixes two versions. Our scripts import each other by relative URLs, and so stay within a version.
"""

import gzip
import hashlib
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import PurePath

TYPES = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
BORROWED = {  # from their packages: name, package, folder in it
    "swagger-ui-bundle.js": ("fastapi_swagger", "resources"),
    "swagger-ui.css": ("fastapi_swagger", "resources"),
}


@dataclass(frozen=True)
class Asset:
    """A static file: its bytes, the same compressed with gzip, and its media type."""

    content: bytes
    packed: bytes
    media_type: str


@cache
def assets() -> dict[str, Asset]:
    """Return all assets by name; a name from a URL is looked up here and never used as a path."""
    own = resources.files("skills") / "api" / "pages" / "static"
    files = {file.name: file.read_bytes() for file in own.iterdir() if file.is_file()}
    for name, (package, folder) in BORROWED.items():
        files[name] = (resources.files(package) / folder / name).read_bytes()
    kinds = {name: TYPES.get(PurePath(name).suffix) for name in files}
    # without a time, so that the same build has the same bytes
    packed = {name: gzip.compress(content, compresslevel=5, mtime=0) for name, content in files.items()}
    return {name: Asset(files[name], packed[name], kind) for name, kind in kinds.items() if kind is not None}


@cache
def build() -> str:
    """Return the digest of all assets, which is part of their URLs."""
    seen = hashlib.sha256()
    for name, asset in sorted(assets().items()):
        seen.update(name.encode() + hashlib.sha256(asset.content).digest())
    return seen.hexdigest()[:16]
