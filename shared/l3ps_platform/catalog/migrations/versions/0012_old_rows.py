"""Indexes by which what is old, and whose an object is, are found"""

from alembic import op

revision = "0012"
down_revision = "0011"

ARCHIVES = ("annotations", "drives", "models")


def upgrade() -> None:
    for table in ARCHIVES:
        op.create_index(f"ix_{table}_object_key", table, ["object_key"])
    op.create_index("ix_uploads_created_at", "uploads", ["created_at"])


def downgrade() -> None:
    op.drop_index("ix_uploads_created_at", "uploads")
    for table in ARCHIVES:
        op.drop_index(f"ix_{table}_object_key", table)
