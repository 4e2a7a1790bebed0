"""The decision of each route's requirements, over every caller: role, restriction and path."""

import asyncio
from itertools import product

import pytest
from fastapi.requests import HTTPConnection

from skills.api.authorisation import Caller, Needs, _caller, refuse_release
from skills.errors import NotAllowed, NotFound, NotSignedIn

LADDER = ("reader", "uploader", "trainer", "releaser", "admin")


def asked(caller: Caller | None, surgeon: str | None = None) -> HTTPConnection:
    scope = {"type": "http", "caller": caller, "path_params": {} if surgeon is None else {"surgeon": surgeon}}
    return HTTPConnection(scope)


def decided(needs: Needs, request: HTTPConnection) -> type[Exception] | None:
    try:
        asyncio.run(needs(request))
    except (NotAllowed, NotFound, NotSignedIn) as refused:
        return type(refused)
    return None


@pytest.mark.parametrize("whole", [False, True])
def test_role_then_restriction_then_surgeon_decide(whole: bool):
    for (has, role), (needs, least) in product(enumerate(LADDER), repeat=2):
        for surgeons, surgeon in product((None, frozenset({"kestrel"}), frozenset()), (None, "kestrel", "heron")):
            if has < needs:
                expected = NotAllowed
            elif surgeons is None:
                expected = None
            elif whole:
                expected = NotAllowed
            else:
                expected = NotFound if surgeon is not None and surgeon not in surgeons else None
            caller = Caller("anna", role, surgeons=surgeons)
            assert decided(Needs(least, whole), asked(caller, surgeon)) is expected, (role, least, surgeons, surgeon)


def test_a_route_for_a_role_refuses_a_request_without_a_caller():
    assert decided(Needs("reader"), asked(None)) is NotSignedIn
    assert decided(Needs(None), asked(None)) is None
    with pytest.raises(NotSignedIn):
        asyncio.run(_caller(HTTPConnection({"type": "http"})))
    anna = Caller("anna", "reader")
    assert asyncio.run(_caller(asked(anna))) is anna


def test_a_requirement_concerns_the_whole_installation_only_if_it_says_so():
    assert not Needs("reader").whole


@pytest.mark.parametrize("role", LADDER)
def test_a_training_that_also_releases_needs_a_releaser(role: str):
    caller = Caller("anna", role)
    for wanted, least in ((False, "reader"), (True, "releaser")):
        if LADDER.index(role) < LADDER.index(least):
            with pytest.raises(NotAllowed, match=f"needs the role {least}"):
                refuse_release(caller, wanted)
        else:
            refuse_release(caller, wanted)
