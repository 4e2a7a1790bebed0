"""One HTML page with everything in it: pictures as data URIs, no script, nothing from any other address."""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from skills.report.sections import COMMAND, SECTIONS, Section
from skills.report.tables import Table

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1b1f24; background: #fff; max-width: 76rem; margin: 2rem auto;
  padding: 0 1rem; }
h1, h2 { line-height: 1.2; } h2 { margin-top: 3rem; border-top: 1px solid #d0d7de; padding-top: 1.5rem; }
p { max-width: 48rem; } img { max-width: 100%; height: auto; }
table { border-collapse: collapse; margin: 1rem 0; } caption { text-align: left; font-weight: 600; padding: .3rem 0; }
th, td { border-bottom: 1px solid #d0d7de; padding: .25rem .8rem .25rem 0; text-align: left; vertical-align: top; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
.made { color: #57606a; font-size: .9rem; } .notice { border-left: 4px solid #d55e00; padding-left: .8rem; }
nav a { margin-right: 1rem; } .wide { overflow-x: auto; }
"""
# Nothing may be fetched, wherever the page is opened.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


@dataclass(frozen=True)
class Part:
    """What one source gives to the page: its title, a picture and the tables of each figure."""

    title: str
    pictures: Mapping[str, Path]
    tables: Mapping[str, Sequence[Table]]


def write_page(parts: Sequence[Part], printed: Table, notices: Sequence[str], options: str) -> str:
    """Write the page.

    Args:
        parts: One for each source, the paper's own after the sample.
        printed: The printed RMSE, which is of no source.
        notices: Sentences that stand at the top.
        options: The command's options, so that the page says how it was made.
    """
    links = " ".join(f'<a href="#{one.name}">{escape(one.title.split(":")[0])}</a>' for one in SECTIONS)
    body = "".join(_section(one, parts, printed, options) for one in SECTIONS)
    told = "".join(f'<p class="notice">{escape(one)}</p>' for one in notices)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        f'<meta name="viewport" content="width=device-width"><title>The paper, redrawn</title>'
        f"<style>{STYLE}</style></head><body><h1>The paper, redrawn</h1>"
        "<p>Collaborative Suturing: A Reinforcement Learning Approach to Automate Hand-off Task in Suturing for "
        "Surgical Robots: its Figures 5 to 9 and Table I, computed anew, and what the paper did not compare: two "
        "rivals, and arms that slip. Research use only.</p>"
        "<p>Axes are in mm in the frame of the arm's base, and not to one scale.</p>"
        f"{told}<nav>{links}</nav>{body}</body></html>\n"
    )


def _section(section: Section, parts: Sequence[Part], printed: Table, options: str) -> str:
    tables = [printed] if section.name == "table-1" else []
    drawn = "".join(_part(section, one) for one in parts)
    made = f"Command: {COMMAND} {options}. Seed: {section.seed}. Tolerance: {section.tolerance}."
    return (
        f'<section id="{section.name}"><h2>{escape(section.title)}</h2>'
        f"<p><b>The paper:</b> {escape(section.paper)}</p><p><b>Here:</b> {escape(section.here)}</p>"
        f'<p class="made">{escape(made)}</p>{"".join(map(_table, tables))}{drawn}</section>'
    )


def _part(section: Section, part: Part) -> str:
    picture = part.pictures.get(section.name)
    image = "" if picture is None else _image(picture, f"{section.title}, {part.title}")
    return f"<h3>{escape(part.title)}</h3>{image}" + "".join(map(_table, part.tables[section.name]))


def _image(picture: Path, alt: str) -> str:
    data = b64encode(picture.read_bytes()).decode()
    return f'<img alt="{escape(alt, quote=True)}" src="data:image/png;base64,{data}">'


def _table(table: Table) -> str:
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in table.columns)
    rows = "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in table.rows)
    return (
        f'<div class="wide"><table id="{table.name}"><caption>{escape(table.caption)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _cell(value: str | int | float) -> str:
    if isinstance(value, str):
        return f"<td>{escape(value)}</td>"
    return f'<td class="number">{value:g}</td>'
