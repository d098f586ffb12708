"""The catalog's first tables"""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0001"
down_revision = None

JSON = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")
DATE = sa.DateTime(timezone=True)


def states(*values: str, name: str) -> sa.Enum:
    return sa.Enum(*values, name=name, native_enum=False, create_constraint=True, length=16)


def upgrade() -> None:
    op.create_table(
        "drives",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("filename", sa.String(), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=True),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.Column("format", sa.String(length=32), nullable=True),
        sa.Column("state", states("uploaded", "validating", "ready", "rejected", name="drivestate"), nullable=False),
        sa.Column("problem", JSON, nullable=True),
        sa.Column("info", JSON, nullable=True),
        sa.Column("object_key", sa.String(), nullable=True),
        sa.Column("created_at", DATE, nullable=False),
        sa.Column("deleted_at", DATE, nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_drives")),
    )
    op.create_table(
        "models",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("filename", sa.String(), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=True),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.Column("state", states("uploaded", "validating", "ready", "rejected", name="modelstate"), nullable=False),
        sa.Column("problem", JSON, nullable=True),
        sa.Column("info", JSON, nullable=True),
        sa.Column("object_key", sa.String(), nullable=True),
        sa.Column("created_at", DATE, nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_models")),
        sa.UniqueConstraint("name", name=op.f("uq_models_name")),
    )
    op.create_table(
        "uploads",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("filename", sa.String(), nullable=False),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=True),
        sa.Column("parts", sa.BigInteger(), nullable=False),
        sa.Column("state", states("open", "complete", "aborted", name="uploadstate"), nullable=False),
        sa.Column("object_key", sa.String(), nullable=False),
        sa.Column("s3_upload_id", sa.String(), nullable=False),
        sa.Column("result_id", sa.String(length=32), nullable=True),
        sa.Column("created_at", DATE, nullable=False),
        sa.Column("expires_at", DATE, nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_uploads")),
    )
    op.create_index("ix_uploads_state_expires_at", "uploads", ["state", "expires_at"])

    op.create_table(
        "jobs",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("drive_id", sa.String(length=32), nullable=False),
        sa.Column("model_id", sa.String(length=32), nullable=False),
        sa.Column("settings", JSON, nullable=False),
        sa.Column(
            "state", states("queued", "running", "succeeded", "failed", "cancelled", name="jobstate"), nullable=False
        ),
        sa.Column("cancel_requested", sa.Boolean(), nullable=False),
        sa.Column("error", JSON, nullable=True),
        sa.Column("quality", JSON, nullable=True),
        sa.Column("created_at", DATE, nullable=False),
        sa.Column("started_at", DATE, nullable=True),
        sa.Column("finished_at", DATE, nullable=True),
        sa.ForeignKeyConstraint(["drive_id"], ["drives.id"], name=op.f("fk_jobs_drive_id_drives")),
        sa.ForeignKeyConstraint(["model_id"], ["models.id"], name=op.f("fk_jobs_model_id_models")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_jobs")),
    )
    op.create_index("ix_jobs_drive_id", "jobs", ["drive_id"])
    op.create_index("ix_jobs_state", "jobs", ["state"])

    op.create_table(
        "scenes",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("job_id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("position", sa.BigInteger(), nullable=False),
        sa.Column("scans", sa.BigInteger(), nullable=False),
        sa.Column("points", sa.BigInteger(), nullable=False),
        sa.Column(
            "state",
            states("waiting", "queued", "running", "done", "failed", "cancelled", name="stagestate"),
            nullable=False,
        ),
        sa.Column("quality", JSON, nullable=True),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name=op.f("fk_scenes_job_id_jobs"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_scenes")),
        sa.UniqueConstraint("job_id", "position", name=op.f("uq_scenes_job_id")),
    )
    op.create_table(
        "stages",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("scene_id", sa.String(length=32), nullable=True),
        sa.Column("job_id", sa.String(length=32), nullable=True),
        sa.Column("drive_id", sa.String(length=32), nullable=True),
        sa.Column("model_id", sa.String(length=32), nullable=True),
        sa.Column("name", states("ingest", "segment", "refine", "publish", name="stagename"), nullable=False),
        sa.Column("queue", states("segment", "refine", name="queuename"), nullable=False),
        sa.Column(
            "state",
            states("waiting", "queued", "running", "done", "failed", "cancelled", name="stagestate"),
            nullable=False,
        ),
        sa.Column("attempt", sa.BigInteger(), nullable=False),
        sa.Column("not_before", DATE, nullable=True),
        sa.Column("lease_owner", sa.String(), nullable=True),
        sa.Column("lease_until", DATE, nullable=True),
        sa.Column("progress_step", sa.String(length=32), nullable=True),
        sa.Column("progress_done", sa.BigInteger(), nullable=False),
        sa.Column("progress_total", sa.BigInteger(), nullable=False),
        sa.Column("fraction", sa.Double(), nullable=False),
        sa.Column("seconds", sa.Double(), nullable=True),
        sa.Column("cpu_seconds", sa.Double(), nullable=True),
        sa.Column("peak_mb", sa.Double(), nullable=True),
        sa.Column("scans", sa.BigInteger(), nullable=True),
        sa.Column("points", sa.BigInteger(), nullable=True),
        sa.Column("cached", sa.Boolean(), nullable=False),
        sa.Column("output_key", sa.String(), nullable=True),
        sa.Column("error", JSON, nullable=True),
        sa.Column("queued_at", DATE, nullable=True),
        sa.Column("started_at", DATE, nullable=True),
        sa.Column("finished_at", DATE, nullable=True),
        sa.ForeignKeyConstraint(["drive_id"], ["drives.id"], name=op.f("fk_stages_drive_id_drives")),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name=op.f("fk_stages_job_id_jobs"), ondelete="CASCADE"),
        sa.ForeignKeyConstraint(["model_id"], ["models.id"], name=op.f("fk_stages_model_id_models")),
        sa.ForeignKeyConstraint(
            ["scene_id"], ["scenes.id"], name=op.f("fk_stages_scene_id_scenes"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_stages")),
    )
    op.create_index("ix_stages_job_id", "stages", ["job_id"])
    op.create_index("ix_stages_scene_id", "stages", ["scene_id"])
    op.create_index("ix_stages_state_lease_until", "stages", ["state", "lease_until"])

    op.create_table(
        "steps",
        sa.Column("stage_id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=32), nullable=False),
        sa.Column("seconds", sa.Double(), nullable=False),
        sa.Column("peak_mb", sa.Double(), nullable=False),
        sa.ForeignKeyConstraint(["stage_id"], ["stages.id"], name=op.f("fk_steps_stage_id_stages"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("stage_id", "name", name=op.f("pk_steps")),
    )


def downgrade() -> None:
    op.drop_table("steps")
    op.drop_index("ix_stages_state_lease_until", table_name="stages")
    op.drop_index("ix_stages_scene_id", table_name="stages")
    op.drop_index("ix_stages_job_id", table_name="stages")

    op.drop_table("stages")
    op.drop_table("scenes")
    op.drop_index("ix_jobs_state", table_name="jobs")
    op.drop_index("ix_jobs_drive_id", table_name="jobs")

    op.drop_table("jobs")
    op.drop_index("ix_uploads_state_expires_at", table_name="uploads")

    op.drop_table("uploads")
    op.drop_table("models")
    op.drop_table("drives")
