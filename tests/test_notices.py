"""NOTICE: the licences of what serving installs, compared with the lock and with the packages themselves."""

import re
import subprocess

import imageio_ffmpeg

from tests.notices import ROOT, licence_of, locked

NOTICE = (ROOT / "NOTICE").read_text()
STATED = dict(re.findall(r"^([\w.-]+) {2,}(.+)$", NOTICE.partition("package    ")[2], re.MULTILINE))


def test_every_package_of_the_serving_lock_has_its_licence():
    assert sorted(STATED) == locked("requirements-serve.lock")
    other = {name: found for name, licence in STATED.items() if (found := licence_of(name)) not in (None, licence)}
    assert not other, "python -m tests.notices prints the table"


def test_the_serving_lock_is_a_part_of_the_whole_one():
    def pins(name: str) -> set[str]:
        return set(re.findall(r"^[\w.-]+==[^ ;\\]+", (ROOT / name).read_text(), re.MULTILINE))

    assert pins("requirements-serve.lock") <= pins("requirements.lock")
    assert "pytest" not in locked("requirements-serve.lock")


def test_licences_that_ask_for_more_than_their_text_are_explained():
    strong = [name for name, licence in STATED.items() if re.search(r"GPL", licence)]
    explained = NOTICE.partition("package    ")[0]
    assert strong == ["psycopg", "psycopg-binary"]
    assert all(name in explained for name in strong)
    program = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-L"], capture_output=True, text=True, check=True)
    terms = " ".join(program.stdout.split())
    assert "GNU General Public License" in terms
    assert "version 3 of the License, or (at your option) any later" in terms
    assert "GNU General Public License, version 3 or later" in " ".join(explained.split())
