"""When a webhook had its last turn and until when it is left alone; indexes by which its turn is found"""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"


def upgrade() -> None:
    op.add_column("webhooks", sa.Column("attempted_at", sa.DateTime(timezone=True), nullable=True))
    op.add_column("webhooks", sa.Column("paused_until", sa.DateTime(timezone=True), nullable=True))
    op.create_index("ix_deliveries_webhook_id_state_next_at", "deliveries", ["webhook_id", "state", "next_at"])
    op.create_index("ix_deliveries_lease_until", "deliveries", ["lease_until"])


def downgrade() -> None:
    op.drop_index("ix_deliveries_lease_until", "deliveries")
    op.drop_index("ix_deliveries_webhook_id_state_next_at", "deliveries")
    op.drop_column("webhooks", "paused_until")
    op.drop_column("webhooks", "attempted_at")
