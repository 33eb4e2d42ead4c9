"""The tables of the catalogue; `service/migrations` makes them."""

import sqlalchemy as sa

METADATA = sa.MetaData()


def _of_scan() -> tuple[sa.String, sa.ForeignKey]:
    return sa.String(), sa.ForeignKey("scans.scan_id", ondelete="CASCADE")


SCANS = sa.Table(
    "scans",
    METADATA,
    sa.Column("scan_id", sa.String, primary_key=True),
    sa.Column("tree_id", sa.String, nullable=False),
    sa.Column("state", sa.String, nullable=False),
    sa.Column("request", sa.JSON, nullable=False),
    sa.Column("views_done", sa.Integer, nullable=False),
    sa.Column("views_total", sa.Integer, nullable=False),
    sa.Column("detail", sa.String, nullable=False),
    sa.Column("recording", sa.String),
    sa.Column("kind", sa.String, nullable=False, server_default="scan"),
    sa.Column("created_ns", sa.BigInteger, nullable=False, index=True),
    sa.Column("updated_ns", sa.BigInteger, nullable=False),
)
EVENTS = sa.Table(
    "events",
    METADATA,
    sa.Column("scan_id", *_of_scan(), primary_key=True),
    sa.Column("seq", sa.Integer, primary_key=True),
    sa.Column("kind", sa.String, nullable=False),
    sa.Column("data", sa.JSON, nullable=False),
)
REVISIONS = sa.Table(
    "revisions",
    METADATA,
    sa.Column("scan_id", *_of_scan(), primary_key=True),
    sa.Column("revision", sa.Integer, primary_key=True),
    sa.Column("sha256", sa.String(64), nullable=False),
    sa.Column("path", sa.String, nullable=False),
)
IDEMPOTENCY = sa.Table(
    "idempotency",
    METADATA,
    sa.Column("key", sa.String, primary_key=True),
    sa.Column("body_sha256", sa.String(64), nullable=False),
    sa.Column("scan_id", *_of_scan(), nullable=False),
    sa.Column("response", sa.JSON, nullable=False),
    sa.Column("created_ns", sa.BigInteger, nullable=False),
)
STOPS = sa.Table(
    "stops",
    METADATA,
    sa.Column("seq", sa.Integer, primary_key=True),
    sa.Column("stopped_ns", sa.BigInteger, nullable=False),
    sqlite_autoincrement=True,  # no number twice: a later stop is not the one acknowledged
)
