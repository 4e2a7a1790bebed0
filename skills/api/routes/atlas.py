"""The atlas of a suture type."""

from typing import Annotated

from fastapi import APIRouter, Query, Response

from skills.api.access import needs
from skills.api.deps import DIGEST, Db, Slug
from skills.api.documented import gives
from skills.api.replies import Giving
from skills.api.schemas.given import Atlas
from skills.library.atlas import MOST, atlas_of
from skills.settings import MEBIBYTE

router = APIRouter(tags=["atlas"], max_body_size=MEBIBYTE)

Clusters = Annotated[int | None, Query(ge=1, le=MOST, description="How many; left out, as many as are found.")]
AskedDemo = Annotated[str | None, Query(pattern=DIGEST, description="Whose style is this one?")]


@router.get("/styles/{suture}/atlas", dependencies=[needs("reader")], **gives(Atlas, 404, 409))
def get_atlas(
    suture: Slug,
    db: Db,
    give: Giving,
    scaled: Annotated[bool, Query(description="Whether size is taken out too.")] = False,
    clusters: Clusters = None,
    demo: AskedDemo = None,
) -> Response:
    """Compare all demonstrations of a suture type whose surgeons' consent covers it.

    The first time takes as long as measuring does, seconds for hundreds of demonstrations; a new one costs one row.
    """
    return give(atlas_of(db, suture, scaled=scaled, clusters=clusters, demo=demo))
