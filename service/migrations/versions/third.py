"""Replays beside scans."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision: str | None = "0002"


def upgrade() -> None:
    """Say of each scan what kind it is; those there are have moved the arm."""
    kind = sa.Column("kind", sa.String, nullable=False, server_default="scan")
    op.add_column("scans", kind)


def downgrade() -> None:
    """Forget it, and replays: taken for scans, they would hold the arm."""
    op.execute("DELETE FROM scans WHERE kind = 'replay'")
    op.drop_column("scans", "kind")
