"""CITATION.cff is of the Citation File Format 1.2.0, and agrees with pyproject.toml."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text())
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def keys(line: str) -> set[str]:
    return set(line.split())


# The keys of the format that the file uses, or may; a misspelt one is none of them (citation-file-format.github.io).
OF_FILE = keys(
    "cff-version message title authors abstract contact date-released doi identifiers keywords license license-url "
    "preferred-citation references repository repository-artifact repository-code type url version"
)
OF_REFERENCE = keys(
    "type title authors scope abstract collection-title conference doi year month start end publisher url notes"
)
OF_PERSON = keys("family-names given-names name-particle name-suffix alias affiliation orcid email website")
OF_ENTITY = keys("name website email city country orcid date-start date-end")
DOI = re.compile(r"10\.\d{4,9}(\.\d+)?/[A-Za-z0-9:/_;\-.()\[\]\\]+")


def wrong_authors(authors: Any) -> list[Any]:
    """List the authors that are neither a person nor an entity."""
    return [
        one for one in authors if not one or not (set(one) <= OF_PERSON or ("name" in one and set(one) <= OF_ENTITY))
    ]


def test_the_file_has_the_required_keys_and_no_unknown_ones():
    assert {"cff-version", "message", "title", "authors"} <= set(CITATION) <= OF_FILE
    assert CITATION["cff-version"] == "1.2.0"
    assert CITATION["type"] == "software"
    assert CITATION["authors"]
    assert wrong_authors(CITATION["authors"]) == []


def test_the_paper_is_cited_with_what_its_kind_needs():
    (paper,) = CITATION["references"]
    assert {"type", "title", "authors"} <= set(paper) <= OF_REFERENCE
    assert paper["type"] == "conference-paper"
    assert paper["title"] in (ROOT / "README.md").read_text().replace("\n", " ")
    assert wrong_authors(paper["authors"]) == []
    assert DOI.fullmatch(paper["doi"])
    assert isinstance(paper["year"], int)
    assert set(paper["conference"]) <= OF_ENTITY


def test_version_licence_and_name_are_those_of_the_project():
    assert (CITATION["version"], CITATION["license"]) == (PROJECT["version"], PROJECT["license"])
    assert CITATION["title"].startswith(PROJECT["name"])


def test_the_changelog_begins_with_this_release_or_the_next_one():
    newest = (ROOT / "CHANGELOG.md").read_text().split("\n## ")[1].partition("\n")[0]
    assert newest == f"{CITATION['version']}, {CITATION['date-released']}" or newest.endswith(", unreleased")
    assert f"version {'.'.join(CITATION['version'].split('.')[:2])}." in (ROOT / "README.md").read_text()


@pytest.mark.parametrize("wrong", [{"family": "Varier"}, {"given-names": "V", "name": "Varier"}, {}])
def test_an_author_with_a_wrong_key_would_be_found(wrong):
    assert wrong_authors([wrong]) == [wrong]
