"""`make faults [FAULTS="full-disk ..."]`: inflict faults on the real service, and print and write the table.

The table is written to `build/faults.txt`. The exit code is 1 if something was lost, doubled, served wrongly or
answered with an internal error.
"""

import random
import sys
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

from tests import leftovers
from tests.faults.rows import Fault, Row, named, run

TARGET = Path("build/faults.txt")
SAID = 6  # answers and log lines that a row shows
HEAD = (
    "| fault and its duration | acknowledged | lost | doubled | served wrongly (of reads) | given up | "
    "s to an upload, to a release | answered | logged |\n|---|---|---|---|---|---|---|---|---|\n"
)


def main() -> None:
    """Run the named faults, or all."""
    guarding = leftovers.begin()
    seed = random.randrange(10**6)
    print(f"seed {seed}")
    TARGET.parent.mkdir(exist_ok=True)
    TARGET.write_text(HEAD)
    bad = False
    try:
        for fault in named(sys.argv[1:]):
            line, wrong = try_out(fault, seed)
            bad = bad or wrong
            print(line, flush=True)
            with TARGET.open("a") as table:
                table.write(line + "\n")
    finally:
        for left in leftovers.end(guarding):
            print(f"LEFT BEHIND - {left}")
    sys.exit(bad)


def try_out(fault: Fault, seed: int) -> tuple[str, bool]:
    """Inflict a fault; return the row of the table, and whether it has what must never be."""
    if fault.lacks:
        return f"| {fault.words} | NOT TESTED: {fault.lacks} | | | | | | | |", False
    with TemporaryDirectory(prefix="skills-faults-") as folder:
        try:
            row = run(fault, Path(folder), seed)
        except AssertionError as error:
            print(*error.__notes__, sep="\n")
            return f"| {fault.words} | NOT RECOVERED: {error} | | | | | | | |", True
    for what in (row.bugs, row.verdict.lost, row.verdict.doubled, row.verdict.wrong, row.verdict.given_up):
        print(*what[:20], sep="\n", end="\n" if what else "")
    return written(row), failed(row)


def failed(row: Row) -> bool:
    """Return whether a row has what must never be."""
    found = row.verdict
    return bool(found.lost or found.doubled or found.wrong or internal_errors(row))


def internal_errors(row: Row) -> list[str]:
    """List the answers that tell of a bug."""
    return [answer for answer in row.answered if " 500 " in answer]


def written(row: Row) -> str:
    """Return a row of the table."""
    found = row.verdict
    acked = ", ".join(f"{count} {kind}s" for kind, count in found.acknowledged.items())
    to_upload, to_release = (row.recovered_s[kind] for kind in ("upload", "release"))
    answered = "; ".join(f"{answer} ({count})" for answer, count in row.answered.most_common(SAID)) or "-"
    exits = [f"exit {code} ({count})" for code, count in Counter(row.exits).items()]
    logged = "; ".join([*exits, *(f"{said} ({count})" for said, count in row.logged.most_common(SAID))]) or "-"
    return (
        f"| {row.fault.words}, {row.held_s:.0f} s | {acked} | {len(found.lost)} | {len(found.doubled)} | "
        f"{len(found.wrong)} ({found.reads}) | {len(found.given_up)} | {to_upload:.1f}, {to_release:.1f} | "
        f"{answered} | {logged} |"
    )


if __name__ == "__main__":
    main()
