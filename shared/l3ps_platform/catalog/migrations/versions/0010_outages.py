"""How long a stage has waited in outages, instead of since when; and how often it lost its worker."""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"


def upgrade() -> None:
    op.add_column("stages", sa.Column("losses", sa.BigInteger(), nullable=False, server_default="0"))
    op.add_column("stages", sa.Column("outage_seconds", sa.Double(), nullable=False, server_default="0"))
    op.drop_column("stages", "outage_since")


def downgrade() -> None:
    op.add_column("stages", sa.Column("outage_since", sa.DateTime(timezone=True), nullable=True))
    op.drop_column("stages", "outage_seconds")
    op.drop_column("stages", "losses")
