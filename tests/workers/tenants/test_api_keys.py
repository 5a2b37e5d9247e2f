"""Keys in the database: found only by their text, and only while they are valid."""

from __future__ import annotations

import asyncio
import hmac
from datetime import timedelta

import psycopg
import pytest

from biresnerf.errors import InputError
from workers.engine import Stores, open_stores
from workers.settings.errors import NotFound, Unavailable
from workers.settings.settings import Settings
from workers.tenants import api_keys, tokens
from workers.tenants.api_keys import KeyRefused

pytestmark = pytest.mark.anyio


async def test_a_key_is_recognised_by_its_text_and_no_other(stores: Stores):
    key, text = await stores.keys.create("anna", "laptop", ["read"])
    assert text.startswith(f"{key.prefix}_")
    assert len(text.removeprefix(f"{key.prefix}_")) == 43  # 256 bits in base64
    found = await stores.keys.recognise(text)
    assert (found.id, found.tenant, found.scopes) == (key.id, "anna", ("read",))
    for wrong in (
        text[:-1],
        text + "A",
        text[:-1] + ("A" if text[-1] != "A" else "B"),
        text.lower(),
        "",
        "\0",
    ):
        with pytest.raises(KeyRefused):
            await stores.keys.recognise(wrong)


async def test_two_keys_never_have_a_text_in_common(stores: Stores):
    texts = {(await stores.keys.create("anna", "n", ["read"]))[1] for _ in range(20)}
    assert len(texts) == 20


async def test_an_expired_or_revoked_key_is_refused(stores: Stores):
    _, expired = await stores.keys.create("anna", "n", ["read"], lives=timedelta(seconds=-1))
    key, revoked = await stores.keys.create("anna", "n", ["read"], lives=timedelta(days=1))
    assert (await stores.keys.recognise(revoked)).id == key.id
    await stores.keys.revoke(key.id)
    for text in (expired, revoked):
        with pytest.raises(KeyRefused):
            await stores.keys.recognise(text)
    with pytest.raises(NotFound):
        await stores.keys.revoke("key_0000")


async def test_the_database_holds_no_text_of_a_key(stores: Stores, settings: Settings):
    _, text = await stores.keys.create("anna", "n", ["read"])
    async with await psycopg.AsyncConnection.connect(settings.require_database_url()) as connection:
        row = await (await connection.execute("SELECT api_keys::text FROM api_keys")).fetchone()
    assert text.rsplit("_", 1)[1] not in row[0]


async def test_digests_are_compared_in_constant_time_whether_the_prefix_is_known_or_not(
    stores: Stores, monkeypatch: pytest.MonkeyPatch
):
    _, text = await stores.keys.create("anna", "n", ["read"])
    compared, compare = [], hmac.compare_digest

    def watched(left: bytes, right: bytes) -> bool:
        compared.append((len(left), len(right)))
        return compare(left, right)

    monkeypatch.setattr(tokens.hmac, "compare_digest", watched)
    for wrong in (text[:-1] + ("A" if text[-1] != "A" else "B"), "brn_0000000000_" + "x" * 43, "nonsense"):
        with pytest.raises(KeyRefused):
            await stores.keys.recognise(wrong)
    assert compared == [(32, 32)] * 3


async def test_wrong_tenants_and_scopes_make_no_key(stores: Stores):
    for tenant in ("", "Anna", "a b", "../x", "a" * 64):
        with pytest.raises(InputError, match="tenant"):
            await stores.keys.create(tenant, "n", ["read"])
    for scopes in ([], ["everything"]):
        with pytest.raises(InputError, match="scope"):
            await stores.keys.create("anna", "n", scopes)
    assert not await stores.keys.any_made()


async def test_a_revoked_key_still_counts_as_made(stores: Stores):
    key, _ = await stores.keys.create("anna", "n", ["read"])
    await stores.keys.revoke(key.id)
    assert await stores.keys.any_made()


def transactions(stores: Stores) -> int:
    return stores.keys._database.pool.get_stats()["requests_num"]


async def test_requests_without_a_key_ask_the_database_once_a_second_until_a_key_is_made(
    stores: Stores, settings: Settings
):
    before = transactions(stores)
    for _ in range(3):
        assert not any(await asyncio.gather(*(stores.keys.any_made() for _ in range(500))))
    assert 1 <= transactions(stores) - before < 10  # the rounds may take more than a second
    async with open_stores(settings) as elsewhere:
        await elsewhere.keys.create("anna", "n", ["read"])
    await asyncio.sleep(api_keys.NONE_MADE_S)
    assert await stores.keys.any_made()
    before = transactions(stores)
    assert await stores.keys.any_made()
    assert transactions(stores) == before


async def test_a_key_made_by_the_process_itself_counts_at_once(stores: Stores):
    assert not await stores.keys.any_made()
    await stores.keys.create("anna", "n", ["read"])
    assert await stores.keys.any_made()


async def test_a_database_that_was_away_is_asked_again(stores: Stores, monkeypatch: pytest.MonkeyPatch):
    pool = stores.keys._database.pool
    monkeypatch.setattr(pool, "timeout", 0.2)
    taken = [await pool.getconn() for _ in range(pool.max_size)]
    asked = [asyncio.create_task(stores.keys.any_made()) for _ in range(20)]
    for outcome in await asyncio.gather(*asked, return_exceptions=True):
        assert isinstance(outcome, Unavailable)
    for connection in taken:
        await pool.putconn(connection)
    assert not await stores.keys.any_made()
