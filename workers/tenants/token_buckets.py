"""Token buckets in the database: rate limits that hold over all web processes of an installation."""

from __future__ import annotations

from dataclasses import dataclass

from workers.database.database import Connection, Database

# One statement, so that no two requests take the same token. A refused request writes nothing. The second part sees the
# state before the statement: no row if another request has just used up a new bucket.
_TAKE = """
    WITH taken AS (
        INSERT INTO token_buckets AS bucket (policy, client, full_at)
        VALUES (%(policy)s, %(client)s, clock_timestamp() + %(one)s::interval)
        ON CONFLICT (policy, client) DO UPDATE
            SET full_at = greatest(bucket.full_at, clock_timestamp()) + %(one)s::interval
            WHERE greatest(bucket.full_at, clock_timestamp()) + %(one)s::interval
                <= clock_timestamp() + %(burst)s::int * %(one)s::interval
        RETURNING full_at)
    SELECT true AS passes, extract(epoch FROM full_at - clock_timestamp())::float8 AS full_in_s FROM taken
    UNION ALL
    SELECT false, extract(epoch FROM full_at - clock_timestamp())::float8 FROM token_buckets
        WHERE policy = %(policy)s AND client = %(client)s AND NOT EXISTS (SELECT FROM taken)"""


@dataclass(frozen=True)
class BucketLevel:
    """A bucket after a request. ``wait_s`` is 0 if the request took a token, else the seconds until there is one."""

    tokens: float
    full_in_s: float
    wait_s: float


class TokenBuckets:
    """A bucket for each client of a policy. Get one from `workers.engine.open_stores`."""

    def __init__(self, database: Database) -> None:
        self._database = database

    async def take(self, policy: str, client: str, rate: float, burst: int) -> BucketLevel:
        """Takes a token, if there is one, from a bucket of ``burst`` that gains ``rate`` a second.

        Raises `Unavailable`.
        """
        one_s = 1 / rate
        asked = {"policy": policy, "client": client, "one": f"{one_s:.6f} s", "burst": burst}
        async with self._database.transaction() as connection:
            row = await (await connection.execute(_TAKE, asked)).fetchone()
        passes, full_in_s = (row["passes"], max(0.0, row["full_in_s"])) if row else (False, burst * one_s)
        tokens = min(float(burst), max(0.0, burst - full_in_s * rate))
        return BucketLevel(tokens, full_in_s, 0.0 if passes else max(1e-6, (1 - tokens) * one_s))


async def forget_full_buckets(connection: Connection) -> None:
    """Delete full buckets: a client without a row has one."""
    await connection.execute("DELETE FROM token_buckets WHERE full_at < clock_timestamp()")
