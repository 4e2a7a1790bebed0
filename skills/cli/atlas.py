"""The atlas of a suture type, in tables for people."""

from typing import TYPE_CHECKING, Annotated

import typer

from skills.cli.shell import AsJson, Suture, out, print_json, refusing, service, show

if TYPE_CHECKING:
    from skills.api.schemas.given import Atlas

SHORT = 12  # letters of a digest: enough to tell one from the others of a table

commands = typer.Typer()


@commands.command()
@refusing
def atlas(
    suture: Suture,
    scaled: Annotated[bool, typer.Option("--scaled", help="Take size out too.")] = False,
    clusters: Annotated[int | None, typer.Option(help="How many; else as many as are found.")] = None,
    demo: Annotated[str | None, typer.Option(help="Tell whose style this demonstration is, by its digest.")] = None,
    as_json: AsJson = False,
) -> None:
    """Compare all demonstrations of a suture type: who is near to whom, what sets surgeons apart, whose is whose."""
    with service() as client:
        found = client.atlas(suture, scaled=scaled, clusters=clusters, demo=demo)
    if as_json:
        print_json(found)
        return
    out.print(f"Demonstrations of {suture}: {len(found.demos)}; distances in {found.unit}, about as at one place")
    for sentence in found.left_out.because:
        out.print(sentence, markup=False, soft_wrap=True)
    _tables(found)
    for pair in found.differences:
        out.print(f"- {pair.said}", markup=False, soft_wrap=True)
    _recognition(found)


def _tables(found: "Atlas") -> None:
    surgeons = [
        one.model_dump() | {"medoid": one.medoid[:SHORT], "consistency": _rounded(one.spread)} for one in found.surgeons
    ]
    show(surgeons, False, ("surgeon", "demos", "sessions", "consistency", "medoid"))
    clusters = [
        {
            "cluster": one.cluster,
            "demos": one.demos,
            "spread": _rounded(one.spread),
            "medoid": one.medoid[:SHORT],
            "surgeons": ", ".join(f"{of.demos} of {of.surgeon}" for of in one.surgeons),
        }
        for one in found.clusters
    ]
    show(clusters, False, ("cluster", "demos", "spread", "medoid", "surgeons"))


def _recognition(found: "Atlas") -> None:
    seen = found.recognition
    if seen is None:
        out.print(f"recognition: none. {found.no_recognition_because}", soft_wrap=True)
        return
    low, high = seen.interval
    out.print(
        f"recognition: {seen.right} of {seen.tested} with their session left out, {seen.accuracy:.0%} "
        f"({low:.0%} to {high:.0%}), by chance {seen.chance:.0%}; log loss {seen.log_loss:.2f} nat, guessing "
        f"{seen.log_loss_of_guessing:.2f}",
        soft_wrap=True,
    )
    if found.whose is not None:
        likely = ", ".join(f"{one.surgeon} {one.probability:.0%}" for one in found.whose.likely[:3])
        out.print(f"{found.whose.demo[:SHORT]} of {found.whose.surgeon}: {likely}", soft_wrap=True)
    out.print("Set-up and day are confounded with the surgeon: see docs/atlas.md.")


def _rounded(distance: float | None) -> str | None:
    return None if distance is None else f"{distance:.3g}"
