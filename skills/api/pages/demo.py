"""The report of a demonstration as a page for the surgeon: what to do, the path, the numbers."""

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np

from skills.api.pages import drawing
from skills.api.pages.page import page, table
from skills.style.demo import Demo
from skills.style.grid import GridPath
from skills.style.quality import times_in_words

Report = Mapping[str, Any]
NOT_KNOWN = "not recorded"


def demo_page(about: Mapping[str, Any], report: Report, demo: Demo, path: GridPath) -> str:
    """Write the page.

    Args:
        about: The demonstration as a client is told of it.
        report: What `skills.library.demos.report_on` measured.
        demo: The demonstration.
        path: It in its grid.
    """
    where = f"{about['arm']}, {about['topic']}, in the frame {about['frame']}"
    when = f"{about['start_s']:.2f} s to {about['end_s']:.2f} s of recording {about['recording'][:12]}"
    withdrawn = "" if about["state"] == "active" else '<p class="advice">This demonstration was withdrawn.</p>'
    return page(
        f"A hand-off of {about['surgeon']}, {about['suture']}",
        f'<p class="made">{escape(where)}. {escape(when)}; stored {escape(about["created_at"])}.<br>'
        f"Demonstration {escape(about['id'])}</p>{withdrawn}"
        f"<h2>What to do</h2>{_advice(report['advice'])}"
        f'<h2>The path</h2><div class="views">{drawing.views(demo, path)}</div>{_key(demo)}'
        f"<h2>The speed</h2>{drawing.speed(demo, report['a1_s'])}"
        "<p class='made'>The smoothed speed of the tip. Shaded: the clutch was down or teleoperation did not follow; "
        "that is no part of the path. A1 ends where the tip comes to rest at its goal.</p>"
        f"<h2>The numbers</h2>{_recorded(report)}{_moved(report)}{_in_the_grid(report)}"
        '<p class="made">Measured by suture-skills. Research use only; not a medical device.</p>',
    )


def _advice(advice: list[str]) -> str:
    if not advice:
        return '<p class="well">Nothing: this is a good demonstration to learn from.</p>'
    return f'<ul class="advice">{"".join(f"<li>{escape(one)}</li>" for one in advice)}</ul>'


def _key(demo: Demo) -> str:
    marks = [("raw", "as recorded"), ("grid", "in the grid"), ("start", "start"), ("goal", "goal: the hand-off")]
    if demo.pauses:
        marks.append(("pause", "not driven, left out"))
    if demo.partner is not None:
        marks.append(("partner", f"{demo.partner.arm} as it takes the needle"))
    return f'<ul class="key">{"".join(f"<li>{_mark(kind)} {escape(words)}</li>" for kind, words in marks)}</ul>'


def _mark(kind: str) -> str:
    if kind in ("start", "goal", "partner"):
        shape = f'<circle class="{kind}" cx="9" cy="6" r="5"/>'
    else:
        shape = f'<polyline class="{kind}" points="0,6 18,6"/>'
    return f'<svg viewBox="0 0 18 12" width="18" height="12" aria-hidden="true">{shape}</svg>'


def _recorded(report: Report) -> str:
    clutch = f"{times_in_words(report['clutch_presses'])}, {report['clutched_s']:.1f} s"
    return table(
        "The recording",
        [
            ("Duration", f"{report['duration_s']:.2f} s", f"{report['samples']} samples"),
            ("Rate", f"{report['rate_hz']:.0f} Hz", "from the median step between stamps"),
            ("Longest gap", f"{1000 * report['longest_gap_s']:.0f} ms", "without a sample while the arm was driven"),
            ("Repeated stamps", f"{report['duplicate_stamps']}", "samples dropped, of the whole recording"),
            ("Clutch", clutch, "presses, and how long the pedal was down; quick taps do not count"),
            ("Not driven", f"{report['undriven_s']:.1f} s", "by clutch or without teleoperation; left out of the path"),
        ],
    )


def _moved(report: Report) -> str:
    x, y, z = report["extent_mm"]
    jerk, smoothness = report["jerk_rms_mm_s3"], report["log_dimensionless_jerk"]
    return table(
        "The motion",
        [
            ("Path length", f"{report['path_length_mm']:.1f} mm", "from sample to sample, tremor included"),
            ("Extent", f"{x:.1f} x {y:.1f} x {z:.1f} mm", "of the box around the path"),
            ("Speed", f"{report['speed_median_mm_s']:.1f} mm/s", f"median; peak {report['speed_peak_mm_s']:.1f} mm/s"),
            ("Idle", f"{report['idle_share']:.0%}", "of the driven time slower than 1 mm/s and without a turn"),
            (
                "Smoothness",
                _or("{:.1f}", smoothness),
                "log dimensionless jerk, nearer to 0 is smoother; one even stroke: -5.3",
            ),
            (
                "Smoothness of speed",
                _or("{:.2f}", report["spectral_arc_length"]),
                "spectral arc length, nearer to 0 is smoother; one even stroke: -1.41",
            ),
            ("Jerk", _or("{:.0f} mm/s\u00b3", jerk), "root mean square, of the smoothed tip"),
            ("A1", f"{report['a1_s']:.2f} s", "until the tip comes to rest at its goal"),
            ("Turn in A1", _degrees(report["a1_orientation_change_rad"]), _about_the_turn(report)),
            ("Turn in all", _degrees(report["orientation_change_rad"]), "largest angle from the first orientation"),
            *_partner(report),
        ],
    )


def _in_the_grid(report: Report) -> str:
    grid, (x, y, z) = report["grid"], report["discretisation_rmse_mm"]
    size = " x ".join(str(count) for count in grid["shape"])
    chosen = "the paper's grid" if grid["chosen"] == "paper" else "fitted to this path"
    outside = f"{report['outside_paper_grid_share']:.0%}"
    advised = report["advised_hysteresis"]
    return table(
        "The grid",
        [
            ("Grid", f"{size} cells of {grid['cell_mm']:g} mm", chosen),
            ("Outside the paper's", outside, "of the samples"),
            ("States", f"{report['path_states']}", f"of them {report['bridged_cells']} that no sample lies in"),
            ("Self-crossings", f"{report['revisits']}", "states that it had visited before"),
            ("Back at once", times_in_words(report["returns"]), "into the cell just left, as a tremor does"),
            ("Lost", f"{report['discretisation_rmse_3d_mm']:.2f} mm", f"in x {x:.2f}, in y {y:.2f}, in z {z:.2f} mm"),
            ("Advised hysteresis", "none" if advised is None else f"{advised:g} cells", "to calm a trembling path"),
        ],
    )


def _partner(report: Report) -> list[tuple[str, str, str]]:
    partner = report["partner"]
    if partner is None:
        return [("The other arm", "not known", "no other arm near the hand-off in a frame that both share")]
    x, y, z = partner["position_mm"]
    words = f"{partner['arm']} at {partner['at_s']:.2f} s of the recording; its approach is A2's default in plans"
    return [("The other arm", f"{x:.1f}, {y:.1f}, {z:.1f} mm", words)]


def _about_the_turn(report: Report) -> str:
    negligible = report["a1_turn_negligible"]
    if negligible is None:
        return "the wrist's orientation is not known"
    found = "negligible, as the paper found" if negligible else "not negligible, other than the paper found"
    return f"{found}; 20 degrees move the needle's tip by one cell of 5 mm"


def _degrees(angle_rad: float | None) -> str:
    return NOT_KNOWN if angle_rad is None else f"{np.degrees(angle_rad):.1f}\u00b0"


def _or(form: str, number: float | None) -> str:
    return "too short" if number is None else form.format(number)
