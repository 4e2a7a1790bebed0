"""`make bench [PARTS="reading learning ..."]`: speed as ratios within one run, because absolute times vary."""

import sys

from rich.console import Console
from rich.table import Table

from tests.bench.atlas import atlas
from tests.bench.batches import batches
from tests.bench.beyond import learners
from tests.bench.combining import combining
from tests.bench.containing import containing
from tests.bench.doubt import doubting
from tests.bench.exporting import exporting
from tests.bench.geometry import geometry
from tests.bench.hands import hands
from tests.bench.history import history
from tests.bench.joining import joining
from tests.bench.kinematics import kinematics
from tests.bench.learning import learning
from tests.bench.million import million
from tests.bench.neighbours import neighbours
from tests.bench.playing import playing, verdicts, windows
from tests.bench.pose_styles import pose_styles
from tests.bench.reading import reading
from tests.bench.recognition import recognition
from tests.bench.scaling import scaling
from tests.bench.serving import serving
from tests.bench.session import session
from tests.bench.start import start
from tests.bench.ties import ties
from tests.bench.tissue import tissue
from tests.bench.upkeep import upkeep
from tests.bench.writers import writers

PARTS = {
    "start": start,
    "reading": reading,
    "exporting": exporting,
    "containment": containing,
    "learning": learning,
    "ties": ties,
    "learners": learners,
    "motion": kinematics,
    "playback": playing,
    "verdict": verdicts,
    "windows": windows,
    "doubt": doubting,
    "batches": batches,
    "scaling": scaling,
    "million": million,
    "upkeep": upkeep,
    "writers": writers,
    "history": history,
    "serving": serving,
    "atlas": atlas,
    "neighbours": neighbours,
    "recognition": recognition,
    "combining": combining,
    "geometry": geometry,
    "joining": joining,
    "pose-styles": pose_styles,
    "hands": hands,
    "session": session,
    "tissue": tissue,
}


def main() -> None:
    """Print a table of the requested parts, or of all."""
    table = Table("what", "time", "in proportion", box=None)
    for name in sys.argv[1:] or PARTS:
        PARTS[name](table)
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
