"""A try: from a stored recording to a verdict in one job, and the steps that the job reports.

A choice is the answer to a question or the remedy of a refusal: its `change` holds fields of `TryIn`, so sending the
request again with them applies it. A client needs to know no more: a page makes a button of it, the command line a
command.
"""

from typing import Annotated, Literal

from pydantic import Field, JsonValue, StrictBool

from skills.gridworld.grid import MAX_HYSTERESIS
from skills.schemas import Given
from skills.schemas.plans import PsmMIn
from skills.schemas.playbacks import ErrorsIn, errors_of
from skills.schemas.requests import Coordinate, DigestField, Schema, SlugField, shown
from skills.verification.arm_errors import ArmErrors

LOSS_MM = 2.6  # ours: samples spread evenly in the paper's cells of 5 mm are 2.5 mm (RMSE, 3-D) from the centres


class TryIn(Schema):
    """A try: a stored recording, its style, and the answers to the questions that the service cannot answer itself.

    A question without an answer ends the job with the choices; sent again with one of them, the try goes on, and what
    is stored already is used again.

    Attributes:
        segment: A proposed hand-off, counted from 1, or the whole recording; asked if there are several.
        loss_mm: The coarsest cells of at most 5 mm are taken that lose at most this much: RMSE between samples and the
            centres of their cells, 3-D.
        cell_mm: Length of a cell's edge, in place of the measured choice.
        hysteresis: Hysteresis in cells, in place of the measured choice: 0.25 if the path trembles, else 0.
        release: Release the version if it passes the gate; asked.
        tissue_mm: Height of level tissue in the arm's frame, or none if it is not known; asked.
        errors: Errors of the arms that are to play it; asked.
        psm_m: The arm that takes the needle; if neither this nor the recording has it, there is no hand-off.
    """

    model_config = shown(
        {"recording": "0123456789abcdef" * 4, "surgeon": "kestrel", "suture": "simple-running"},
        {
            **{"recording": "0123456789abcdef" * 4, "surgeon": "kestrel", "suture": "simple-running", "segment": 2},
            **{"tissue_mm": "none", "errors": "calibrated", "release": False},
        },
    )

    recording: DigestField
    surgeon: SlugField
    suture: SlugField
    segment: Literal["whole"] | Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    loss_mm: Annotated[float, Field(gt=0, le=50)] = LOSS_MM
    cell_mm: Annotated[float, Field(ge=0.25, le=50)] | None = None
    hysteresis: Annotated[float, Field(ge=0, le=MAX_HYSTERESIS)] | None = None
    release: StrictBool | None = None
    tissue_mm: Literal["none"] | Coordinate | None = None
    errors: ErrorsIn = None
    psm_m: PsmMIn | None = None

    @property
    def arm_errors(self) -> ArmErrors | None:
        """The errors as a value of the domain."""
        return errors_of(self.errors)


class Choice(Given):
    """An answer or a remedy: the words, and the fields of the request that apply it."""

    words: str
    change: dict[str, JsonValue]


StepName = Literal[
    "read", "propose", "cut", "report", "train", "certify", "release", "tissue", "errors", "plan", "play", "verdict"
]


class TryStep(Given):
    """One step of a try: its effect, its choice and the reason.

    A step that `asks` has the choices, and ends the try unless another asks too; one that is `refused` has the reason,
    its remedies as in a problem document, and the choices that are worth a try.

    Attributes:
        id: The digest of what the step stored: demonstration, version, plan.
    """

    name: StepName
    state: Literal["done", "asks", "refused"]
    text: str
    choices: tuple[Choice, ...] = ()
    remedies: tuple[str | dict[str, str | int], ...] = ()
    id: str | None = None
