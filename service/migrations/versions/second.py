"""Stops that nobody has acknowledged."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision: str | None = "0001"


def upgrade() -> None:
    """Make the table of stops."""
    op.create_table(
        "stops",
        sa.Column("seq", sa.Integer, primary_key=True),
        sa.Column("stopped_ns", sa.BigInteger, nullable=False),
        sqlite_autoincrement=True,
    )


def downgrade() -> None:
    """Drop it."""
    op.drop_table("stops")
