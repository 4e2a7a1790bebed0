"""A column of JSON of one type, on both back ends."""

from collections.abc import Iterator
from datetime import date
from pathlib import Path

import pytest
from sqlalchemy import Column, Integer, MetaData, Table, create_engine, select, text
from sqlalchemy.engine import Engine

from skills.db import AsJson
from skills.errors import Corrupt
from skills.schemas.people import Consent
from tests import backends

CONSENTS = Table(
    "consents", MetaData(), Column("row", Integer, primary_key=True), Column("consent", AsJson(Consent), nullable=True)
)
GIVEN = Consent(uses=["training"], until=date(2099, 12, 31))


@pytest.fixture(params=backends.BACKENDS)
def engine(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Engine]:
    url = backends.blank(request.param, tmp_path)
    engine = create_engine(url)
    CONSENTS.metadata.create_all(engine)
    yield engine
    engine.dispose()
    backends.drop(url)


def test_a_value_comes_back_as_it_was_and_none_is_null(engine: Engine):
    with engine.begin() as connection:
        connection.execute(CONSENTS.insert(), [{"row": 1, "consent": GIVEN}, {"row": 2, "consent": None}])
        assert connection.scalars(select(CONSENTS.c.consent).order_by(CONSENTS.c.row)).all() == [GIVEN, None]
        assert connection.scalar(text("SELECT count(*) FROM consents WHERE consent IS NULL")) == 1
        first = CONSENTS.c.consent["uses"][0].as_string()
        assert connection.scalars(select(CONSENTS.c.row).where(first == "training")).all() == [1]


def test_json_of_another_form_is_corrupt(engine: Engine):
    with engine.begin() as connection:
        connection.execute(text('INSERT INTO consents VALUES (1, \'{"uses": ["sale"]}\')'))
        with pytest.raises(Corrupt, match="a form that this version does not know"):
            connection.scalar(select(CONSENTS.c.consent))
