"""Projects, and the project that every resource belongs to"""

from datetime import UTC, datetime

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"

OWNED = ("uploads", "drives", "models", "annotations", "jobs", "trainings")


def upgrade() -> None:
    projects = op.create_table(
        "projects",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_projects")),
        sa.UniqueConstraint("name", name=op.f("uq_projects_name")),
    )
    op.bulk_insert(projects, [{"id": "prj_default", "name": "default", "created_at": datetime.now(UTC)}])
    for table in OWNED:
        with op.batch_alter_table(table) as batch:
            # What is there already belongs to the default project; new rows name theirs.
            batch.add_column(
                sa.Column("project_id", sa.String(length=32), nullable=False, server_default="prj_default")
            )
            batch.create_foreign_key(op.f(f"fk_{table}_project_id_projects"), "projects", ["project_id"], ["id"])
            batch.create_index(op.f(f"ix_{table}_project_id_id"), ["project_id", "id"])
            if table == "models":
                batch.drop_constraint(op.f("uq_models_name"), type_="unique")
                batch.create_unique_constraint(op.f("uq_models_project_id"), ["project_id", "name"])
        with op.batch_alter_table(table) as batch:
            batch.alter_column("project_id", server_default=None)


def downgrade() -> None:
    for table in OWNED:
        with op.batch_alter_table(table) as batch:
            batch.drop_index(op.f(f"ix_{table}_project_id_id"))
            batch.drop_constraint(op.f(f"fk_{table}_project_id_projects"), type_="foreignkey")
            if table == "models":
                batch.drop_constraint(op.f("uq_models_project_id"), type_="unique")
                batch.create_unique_constraint(op.f("uq_models_name"), ["name"])
            batch.drop_column("project_id")
    op.drop_table("projects")
