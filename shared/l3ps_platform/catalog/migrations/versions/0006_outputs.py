"""Stage outputs and who uses them, deleted jobs and models, retention, the size of an upload's parts"""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"

DATE = sa.DateTime(timezone=True)
STAGES = ("ingest", "segment", "refine", "publish", "train")


def upgrade() -> None:
    op.create_table(
        "outputs",
        sa.Column("key", sa.String(length=200), nullable=False),
        sa.Column("stage", _states(*STAGES, name="stagename"), nullable=False),
        sa.Column("bytes", sa.BigInteger(), nullable=False),
        sa.Column("state", _states("live", "doomed", name="outputstate"), nullable=False),
        sa.Column("created_at", DATE, nullable=False),
        sa.Column("last_used_at", DATE, nullable=False),
        sa.Column("project_id", sa.String(length=32), nullable=False),
        sa.ForeignKeyConstraint(["project_id"], ["projects.id"], name=op.f("fk_outputs_project_id_projects")),
        sa.PrimaryKeyConstraint("key", name=op.f("pk_outputs")),
    )
    op.create_index("ix_outputs_project_id", "outputs", ["project_id"])
    op.create_index("ix_outputs_state", "outputs", ["state"])
    op.create_table(
        "output_uses",
        sa.Column("stage_id", sa.String(length=32), nullable=False),
        sa.Column("output_key", sa.String(length=200), nullable=False),
        sa.ForeignKeyConstraint(
            ["stage_id"], ["stages.id"], name=op.f("fk_output_uses_stage_id_stages"), ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(
            ["output_key"], ["outputs.key"], name=op.f("fk_output_uses_output_key_outputs"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("stage_id", "output_key", name=op.f("pk_output_uses")),
    )
    op.create_index("ix_output_uses_output_key", "output_uses", ["output_key"])
    op.create_table(
        "retention",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("max_age_days", sa.BigInteger(), nullable=True),
        sa.Column("max_bytes", sa.BigInteger(), nullable=True),
        sa.Column("project_id", sa.String(length=32), nullable=False),
        sa.ForeignKeyConstraint(["project_id"], ["projects.id"], name=op.f("fk_retention_project_id_projects")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_retention")),
    )
    for table, columns in (("jobs", ("deleted_at", "swept_at")), ("models", ("deleted_at",))):
        with op.batch_alter_table(table) as batch:
            for column in columns:
                batch.add_column(sa.Column(column, DATE, nullable=True))
    op.create_index("ix_jobs_deleted_at", "jobs", ["deleted_at"])
    with op.batch_alter_table("uploads") as batch:
        batch.add_column(sa.Column("part_size", sa.BigInteger(), nullable=False, server_default="0"))
    with op.batch_alter_table("uploads") as batch:
        batch.alter_column("part_size", server_default=None)
    _note_what_is_there()


def downgrade() -> None:
    with op.batch_alter_table("uploads") as batch:
        batch.drop_column("part_size")
    op.drop_index("ix_jobs_deleted_at", table_name="jobs")
    for table, columns in (("jobs", ("deleted_at", "swept_at")), ("models", ("deleted_at",))):
        with op.batch_alter_table(table) as batch:
            for column in columns:
                batch.drop_column(column)
    op.drop_table("retention")
    op.drop_table("output_uses")
    op.drop_table("outputs")


def _note_what_is_there() -> None:
    """Outputs that finished stages named are in use by them: without a row they would be taken for orphans."""
    connection = op.get_bind()
    project = "COALESCE(jobs.project_id, trainings.project_id)"
    found = connection.execute(
        sa.text(
            f"SELECT stages.id, stages.name, stages.output_key, stages.finished_at, {project} AS project_id "
            "FROM stages LEFT JOIN jobs ON jobs.id = stages.job_id "
            "LEFT JOIN trainings ON trainings.id = stages.training_id "
            "WHERE stages.output_key LIKE 'stages/%' AND stages.state = 'done'"
        )
    ).all()
    outputs, uses = {}, []
    for id, name, output_key, finished_at, project_id in found:
        key = output_key.rpartition("/")[0]
        uses.append({"stage_id": id, "output_key": key})
        outputs[key] = {"key": key, "stage": name, "project_id": project_id, "at": finished_at}
    for row in outputs.values():
        connection.execute(
            sa.text(
                "INSERT INTO outputs (key, stage, bytes, state, created_at, last_used_at, project_id) "
                "VALUES (:key, :stage, 0, 'live', :at, :at, :project_id)"
            ),
            row,
        )
    if uses:
        connection.execute(
            sa.text("INSERT INTO output_uses (stage_id, output_key) VALUES (:stage_id, :output_key)"), uses
        )


def _states(*values: str, name: str) -> sa.Enum:
    return sa.Enum(*values, name=name, native_enum=False, create_constraint=True, length=16)
