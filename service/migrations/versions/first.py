"""Scans, their events and skeleton revisions, idempotency keys."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision: str | None = None


def upgrade() -> None:
    """Make the tables of an empty catalogue."""
    op.create_table(
        "scans",
        sa.Column("scan_id", sa.String, primary_key=True),
        sa.Column("tree_id", sa.String, nullable=False),
        sa.Column("state", sa.String, nullable=False),
        sa.Column("request", sa.JSON, nullable=False),
        sa.Column("views_done", sa.Integer, nullable=False),
        sa.Column("views_total", sa.Integer, nullable=False),
        sa.Column("detail", sa.String, nullable=False),
        sa.Column("recording", sa.String),
        sa.Column("created_ns", sa.BigInteger, nullable=False),
        sa.Column("updated_ns", sa.BigInteger, nullable=False),
    )
    op.create_index("ix_scans_created_ns", "scans", ["created_ns"])
    op.create_table(
        "events",
        sa.Column("scan_id", *_of_scan(), primary_key=True),
        sa.Column("seq", sa.Integer, primary_key=True),
        sa.Column("kind", sa.String, nullable=False),
        sa.Column("data", sa.JSON, nullable=False),
    )
    op.create_table(
        "revisions",
        sa.Column("scan_id", *_of_scan(), primary_key=True),
        sa.Column("revision", sa.Integer, primary_key=True),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("path", sa.String, nullable=False),
    )
    op.create_table(
        "idempotency",
        sa.Column("key", sa.String, primary_key=True),
        sa.Column("body_sha256", sa.String(64), nullable=False),
        sa.Column("scan_id", *_of_scan(), nullable=False),
        sa.Column("response", sa.JSON, nullable=False),
        sa.Column("created_ns", sa.BigInteger, nullable=False),
    )


def _of_scan() -> tuple[sa.String, sa.ForeignKey]:
    return sa.String(), sa.ForeignKey("scans.scan_id", ondelete="CASCADE")


def downgrade() -> None:
    """Drop everything."""
    for table in ("idempotency", "revisions", "events", "scans"):
        op.drop_table(table)
