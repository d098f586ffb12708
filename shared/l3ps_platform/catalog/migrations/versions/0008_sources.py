"""Drives that lie in somebody else's bucket, rules for what arrives there, and what arrived"""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0008"
down_revision = "0007"

JSON = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")
DATE = sa.DateTime(timezone=True)


def upgrade() -> None:
    with op.batch_alter_table("drives") as batch:
        batch.add_column(sa.Column("source", sa.String(), nullable=True))
    op.create_table(
        "rules",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("bucket", sa.String(length=63), nullable=False),
        sa.Column("prefix", sa.String(), nullable=False),
        sa.Column("suffix", sa.String(), nullable=True),
        sa.Column("settings", JSON, nullable=False),
        sa.Column("created_at", DATE, nullable=False),
        sa.Column("project_id", sa.String(length=32), nullable=False),
        sa.ForeignKeyConstraint(["project_id"], ["projects.id"], name=op.f("fk_rules_project_id_projects")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_rules")),
        sa.UniqueConstraint("project_id", "name", name=op.f("uq_rules_project_id")),
    )
    op.create_index(op.f("ix_rules_bucket"), "rules", ["bucket"])
    op.create_index(op.f("ix_rules_project_id_id"), "rules", ["project_id", "id"])
    op.create_table(
        "arrivals",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("rule_id", sa.String(length=32), nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("key", sa.String(), nullable=False),
        sa.Column("source", sa.String(), nullable=False),
        sa.Column("job_id", sa.String(length=32), nullable=True),
        sa.Column("error", JSON, nullable=True),
        sa.Column("created_at", DATE, nullable=False),
        sa.Column("settled_at", DATE, nullable=True),
        sa.Column("project_id", sa.String(length=32), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name=op.f("fk_arrivals_job_id_jobs"), ondelete="SET NULL"),
        sa.ForeignKeyConstraint(["project_id"], ["projects.id"], name=op.f("fk_arrivals_project_id_projects")),
        sa.ForeignKeyConstraint(["rule_id"], ["rules.id"], name=op.f("fk_arrivals_rule_id_rules"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_arrivals")),
        sa.UniqueConstraint("rule_id", "digest", name=op.f("uq_arrivals_rule_id")),
    )
    op.create_index(op.f("ix_arrivals_rule_id_id"), "arrivals", ["rule_id", "id"])
    op.create_index(op.f("ix_arrivals_settled_at"), "arrivals", ["settled_at"])


def downgrade() -> None:
    op.drop_table("arrivals")
    op.drop_table("rules")
    with op.batch_alter_table("drives") as batch:
        batch.drop_column("source")
