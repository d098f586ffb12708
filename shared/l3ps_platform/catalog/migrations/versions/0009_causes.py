"""What counts against a stage apart from the number of its attempts: its own failures, and since when it waits."""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"


def upgrade() -> None:
    op.add_column("stages", sa.Column("failures", sa.BigInteger(), nullable=False, server_default="0"))
    op.add_column("stages", sa.Column("outage_since", sa.DateTime(timezone=True), nullable=True))
    # Attempts before this one have failed, whatever the cause was.
    op.execute("UPDATE stages SET failures = attempt - 1 WHERE state IN ('waiting', 'queued', 'running')")


def downgrade() -> None:
    op.drop_column("stages", "outage_since")
    op.drop_column("stages", "failures")
