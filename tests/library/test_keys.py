"""Keys and sign-ins, on both back ends."""

from datetime import timedelta
from typing import Any

import pytest
from sqlalchemy import select, text, update
from sqlalchemy.orm import Session

from skills.db import Base, now
from skills.db.models import Surgeon
from skills.db.service_tables import Key, SignIn
from skills.db.session import Database
from skills.errors import BadInput, Conflict, NotFound
from skills.library.people import keys
from skills.library.people.erasure import erase_surgeon
from skills.library.people.sign_ins import SignInLifetime, csrf_of, note_use, sign_in, sign_out, signed_in
from skills.settings import Role
from tests.library import cases
from tests.library.cases import fetch

LASTS = SignInLifetime(idle_s=3600, most_s=12 * 3600)


def holder_of(session: Session, key: str) -> keys.Holder | None:
    return keys.holders_of(session, [key]).get(key)


def sign_in_of(session: Session, cookie: str) -> tuple[keys.Holder, bool] | None:
    return signed_in(session, [cookie], LASTS).get(cookie)


def make(database: Database, owner: str = "anna", role: Role = "reader", **how: Any) -> str:
    with database.writing() as session:
        return keys.create_key(session, owner, role, "local", **how)[1]


def test_a_key_is_known_by_what_is_shown_once_and_nowhere_stored(database: Database):
    assert fetch(database, keys.is_keyless)
    key = make(database, role="trainer")
    name, key_id, secret = key.split("_", 2)
    assert (name, len(key_id), len(secret)) == ("skills", 8, 43)  # 256 bits in base64
    with database.reading() as session:
        holder = holder_of(session, key)
        assert holder is not None
        assert (holder.key, holder.owner, holder.role, holder.surgeons) == (key_id, "anna", "trainer", None)
        assert not keys.is_keyless(session)
        for table in Base.metadata.tables:
            for row in session.execute(text(f'SELECT * FROM "{table}"')):
                assert secret not in str(tuple(row)), table
        stored = session.scalars(select(Key)).one()
        assert stored.digest == keys.digest_of(key)
        for wrong in ("", secret, key[:-1], key + "A", key[:-43] + "A" * 43, f"skills_00000000_{secret}", key.upper()):
            assert holder_of(session, wrong) is None, wrong


def test_no_two_keys_are_alike_and_one_owner_may_have_several(database: Database):
    made = [make(database) for _ in range(20)]
    assert len({key.split("_", 2)[2] for key in made}) == 20
    with database.reading() as session:
        assert {keys.about_key(key).owner for key in keys.list_keys(session)} == {"anna"}
        assert len({holder.key for holder in (holder_of(session, key) for key in made) if holder}) == 20


def test_a_revoked_key_is_nobodys_and_the_installation_stays_keyed(database: Database):
    key = make(database)
    with database.writing() as session:
        revoked = keys.revoke_key(session, key.split("_")[1], "local").revoked_at
    with database.writing() as session:
        assert keys.revoke_key(session, key.split("_")[1], "local").revoked_at == revoked
        assert holder_of(session, key) is None
        assert not keys.is_keyless(session)
        with pytest.raises(Conflict, match=r"no valid one.*[Aa]sk the operator of the service for a key"):
            keys.refuse_without_keys(session)
        with pytest.raises(NotFound, match=r"no key with this id. List them: client.keys\(\)"):
            keys.revoke_key(session, "00000000", "local")
        said = session.execute(text("SELECT actor, action FROM events WHERE object_kind = 'key' ORDER BY row")).all()
    assert [tuple(one) for one in said] == [("local", "create"), ("local", "revoke")]
    make(database, role="admin")
    fetch(database, keys.refuse_without_keys)


def test_a_key_that_runs_out_counts_until_that_moment(database: Database):
    end = now() + timedelta(hours=1)
    key = make(database, expires_at=end)
    with database.reading() as session:
        holder = holder_of(session, key)
        assert holder is not None
        assert holder.counts(end - timedelta(microseconds=1))
        assert not holder.counts(end)
    with database.writing() as session:
        session.execute(update(Key).values(expires_at=now()))
    with database.reading() as session:
        assert [keys.about_key(one).state for one in keys.list_keys(session)] == ["expired"]
        with pytest.raises(Conflict):
            keys.refuse_without_keys(session)


@pytest.mark.parametrize(
    ("owner", "how"),
    [
        ("", {}),
        ("local", {}),
        ("worker", {}),
        ("-x", {}),
        ("a\nb", {}),
        ("x" * 65, {}),
        ("<b>", {}),
        ("anna", {"expires_at": now() - timedelta(days=1)}),
        ("anna", {"surgeons": []}),
        ("anna", {"role": "admin", "surgeons": ["kestrel"]}),
    ],
)
def test_what_cannot_be_meant_makes_no_key(database: Database, owner: str, how: dict[str, object]):
    with pytest.raises(BadInput):
        make(database, owner, **how)
    with pytest.raises(NotFound, match="no surgeon 'nobody'"):
        make(database, surgeons=["kestrel", "nobody"])
    assert fetch(database, keys.is_keyless)


def test_a_restricted_key_stays_restricted_when_its_surgeons_are_erased(database: Database):
    cases.add_surgeon(database, "heron")
    key = make(database, surgeons=["heron", "kestrel", "heron"])
    with database.reading() as session:
        holder = holder_of(session, key)
        assert holder is not None
        assert holder.surgeons == {"heron", "kestrel"}
    for slug, left in (("heron", {"kestrel"}), ("kestrel", set())):
        cases.committed(database, erase_surgeon, slug, "local")
        with database.reading() as session:
            holder = holder_of(session, key)
            assert holder is not None
            assert holder.surgeons == left
    assert holder.only is not None
    with database.seen_by(holder.only).reading() as session:
        assert session.scalars(select(Surgeon)).all() == []


def test_a_sign_in_is_known_by_its_cookie_and_over_with_its_key(database: Database):
    key = make(database).split("_")[1]
    with database.writing() as session:
        cookie, other = sign_in(session, key, LASTS), sign_in(session, key, LASTS)
    with database.reading() as session:
        found = sign_in_of(session, cookie)
        assert found is not None
        assert (found[0].owner, found[1]) == ("anna", False)
        assert sign_in_of(session, cookie[:-1] + "!") is None
        assert cookie not in str(session.execute(text("SELECT * FROM sign_ins")).all())
    assert csrf_of(cookie) != csrf_of(other)
    assert len(csrf_of(cookie)) == 64
    with database.writing() as session:
        sign_out(session, other)
        assert sign_in_of(session, other) is None
        assert sign_in_of(session, cookie) is not None
        keys.revoke_key(session, key, "local")
        assert sign_in_of(session, cookie) is None


def test_a_sign_in_is_over_when_it_was_not_used_and_when_it_is_old(database: Database):
    key = make(database).split("_")[1]
    cookie = cases.committed(database, sign_in, key, LASTS)

    def aged(used_s: float, made_s: float) -> tuple[bool, bool]:
        """Return whether a sign-in is valid, and whether its use is to be recorded, for these ages."""
        ago = {"used_at": now() - timedelta(seconds=used_s), "created_at": now() - timedelta(seconds=made_s)}
        with database.writing() as session:
            session.execute(update(SignIn).values(**ago))
        with database.reading() as session:
            found = sign_in_of(session, cookie)
            return found is not None, found is not None and found[1]

    assert aged(5, 5) == (True, False)
    assert aged(3590, 3590) == (True, True)
    assert aged(3601, 3601) == (False, False)
    assert aged(5, 12 * 3600 - 10) == (True, False)
    assert aged(5, 12 * 3600 + 1) == (False, False)
    assert aged(3590, 3590) == (True, True)
    cases.committed(database, note_use, cookie)
    with database.reading() as session:
        found = sign_in_of(session, cookie)
        assert found is not None
        assert not found[1]
    aged(3601, 3601)
    with database.writing() as session:
        sign_in(session, key, LASTS)
        assert len(session.scalars(select(SignIn)).all()) == 1  # expired ones are deleted
