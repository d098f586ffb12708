"""Attempts, the latest figures of every model, and indexes for what is asked most often"""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0007"
down_revision = "0006"

JSON = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")
DATE = sa.DateTime(timezone=True)
NAMES = ("ingest", "segment", "refine", "publish", "train")
INDEXES = {
    "ix_stages_state_name_queued_at": ("stages", ["state", "name", "queued_at"]),
    "ix_stages_drive_id": ("stages", ["drive_id"]),
    "ix_stages_model_id": ("stages", ["model_id"]),
    "ix_jobs_project_id_state_id": ("jobs", ["project_id", "state", "id"]),
    "ix_jobs_drive_id_id": ("jobs", ["drive_id", "id"]),
    "ix_jobs_model_id_id": ("jobs", ["model_id", "id"]),
}


def upgrade() -> None:
    op.create_table(
        "attempts",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("project_id", sa.String(length=32), nullable=False),
        sa.Column("stage_id", sa.String(length=32), nullable=False),
        sa.Column("job_id", sa.String(length=32), nullable=True),
        sa.Column(
            "name",
            sa.Enum(*NAMES, name="stagename", native_enum=False, create_constraint=True, length=16),
            nullable=False,
        ),
        sa.Column("attempt", sa.BigInteger(), nullable=False),
        sa.Column("owner", sa.String(), nullable=False),
        sa.Column("started_at", DATE, nullable=False),
        sa.Column("finished_at", DATE, nullable=False),
        sa.Column("outcome", sa.String(length=16), nullable=False),
        sa.Column("cause", sa.String(length=32), nullable=True),
        sa.Column("seconds", sa.Double(), nullable=False),
        sa.Column("cpu_seconds", sa.Double(), nullable=False),
        sa.Column("peak_mb", sa.Double(), nullable=False),
        sa.Column("scans", sa.BigInteger(), nullable=False),
        sa.Column("points", sa.BigInteger(), nullable=False),
        sa.Column("bytes", sa.BigInteger(), nullable=False),
        sa.Column("cached", sa.Boolean(), nullable=False),
        sa.ForeignKeyConstraint(["project_id"], ["projects.id"], name=op.f("fk_attempts_project_id_projects")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_attempts")),
    )
    op.create_index("ix_attempts_finished_at", "attempts", ["finished_at"])
    op.create_index("ix_attempts_stage_id", "attempts", ["stage_id"])
    op.create_table(
        "model_figures",
        sa.Column("project_id", sa.String(length=32), nullable=False),
        sa.Column("model_id", sa.String(length=32), nullable=False),
        sa.Column("kind", sa.String(length=32), nullable=False),
        sa.Column("job_id", sa.String(length=32), nullable=False),
        sa.Column("figures", JSON, nullable=False),
        sa.Column("finished_at", DATE, nullable=False),
        sa.ForeignKeyConstraint(["project_id"], ["projects.id"], name=op.f("fk_model_figures_project_id_projects")),
        sa.ForeignKeyConstraint(
            ["model_id"], ["models.id"], name=op.f("fk_model_figures_model_id_models"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("model_id", "kind", name=op.f("pk_model_figures")),
    )
    op.drop_index("ix_jobs_drive_id", table_name="jobs")
    for name, (table, columns) in INDEXES.items():
        op.create_index(name, table, columns)
    judged = sa.text("quality IS NOT NULL")
    op.create_index("ix_jobs_with_quality", "jobs", ["id"], sqlite_where=judged, postgresql_where=judged)
    _remember()


def downgrade() -> None:
    for name, (table, _) in INDEXES.items():
        op.drop_index(name, table_name=table)
    op.drop_index("ix_jobs_with_quality", table_name="jobs")
    op.create_index("ix_jobs_drive_id", "jobs", ["drive_id"])
    op.drop_table("model_figures")
    op.drop_table("attempts")


def _remember() -> None:
    """Let the counters begin where they stood: the last attempt of every stage, the latest quality of every model."""
    op.execute("""
        INSERT INTO attempts (project_id, stage_id, job_id, name, attempt, owner, started_at, finished_at, outcome,
                              cause, seconds, cpu_seconds, peak_mb, scans, points, bytes, cached)
        SELECT COALESCE(jobs.project_id, trainings.project_id, drives.project_id, models.project_id),
               stages.id, stages.job_id, stages.name, stages.attempt, '', stages.started_at, stages.finished_at,
               stages.state, CASE stages.state WHEN 'failed' THEN 'unknown' END, COALESCE(stages.seconds, 0),
               COALESCE(stages.cpu_seconds, 0), COALESCE(stages.peak_mb, 0), COALESCE(stages.scans, 0),
               COALESCE(stages.points, 0), 0, stages.cached
        FROM stages
        LEFT JOIN jobs ON jobs.id = stages.job_id
        LEFT JOIN trainings ON trainings.id = stages.training_id
        LEFT JOIN drives ON drives.id = stages.drive_id
        LEFT JOIN models ON models.id = stages.model_id
        WHERE stages.state IN ('done', 'failed', 'cancelled')
          AND stages.started_at IS NOT NULL AND stages.finished_at IS NOT NULL
    """)
    columns: list[sa.ColumnClause[object]] = [
        sa.column(name) for name in ("project_id", "model_id", "id", "finished_at")
    ]
    jobs = sa.table("jobs", *columns, sa.column("quality", JSON))
    figures = sa.table(
        "model_figures",
        *(sa.column(name) for name in ("project_id", "model_id", "kind", "job_id", "finished_at")),
        sa.column("figures", JSON),
    )
    query = sa.select(jobs).where(jobs.c.quality.is_not(None), jobs.c.finished_at.is_not(None))
    latest: dict[tuple[str, str], sa.Row[tuple[object, ...]]] = {}
    for row in op.get_bind().execute(query.order_by(jobs.c.id.desc()).limit(1000)):
        latest.setdefault((row.model_id, row.quality["protocol"]), row)
    for (model_id, protocol), row in latest.items():
        op.execute(
            figures.insert().values(
                project_id=row.project_id,
                model_id=model_id,
                kind=protocol,
                job_id=row.id,
                finished_at=row.finished_at,
                figures=row.quality,
            )
        )
