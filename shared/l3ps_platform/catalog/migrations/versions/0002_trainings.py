"""Annotations, trainings, and the stage and queue that do them"""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0002"
down_revision = "0001"

JSON = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")
DATE = sa.DateTime(timezone=True)


def states(*values: str, name: str) -> sa.Enum:
    return sa.Enum(*values, name=name, native_enum=False, create_constraint=True, length=16)


def upgrade() -> None:
    op.create_table(
        "annotations",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("filename", sa.String(), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=True),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.Column("object_key", sa.String(), nullable=True),
        sa.Column("created_at", DATE, nullable=False),
        sa.Column("deleted_at", DATE, nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_annotations")),
    )
    op.create_table(
        "trainings",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("annotations_id", sa.String(length=32), nullable=False),
        sa.Column("validation_id", sa.String(length=32), nullable=True),
        sa.Column("model_id", sa.String(length=32), nullable=True),
        sa.Column("settings", JSON, nullable=False),
        sa.Column(
            "state", states("queued", "running", "succeeded", "failed", "cancelled", name="jobstate"), nullable=False
        ),
        sa.Column("cancel_requested", sa.Boolean(), nullable=False),
        sa.Column("figures", JSON, nullable=True),
        sa.Column("report", JSON, nullable=True),
        sa.Column("error", JSON, nullable=True),
        sa.Column("log_key", sa.String(), nullable=True),
        sa.Column("created_at", DATE, nullable=False),
        sa.Column("started_at", DATE, nullable=True),
        sa.Column("finished_at", DATE, nullable=True),
        sa.ForeignKeyConstraint(
            ["annotations_id"], ["annotations.id"], name=op.f("fk_trainings_annotations_id_annotations")
        ),
        sa.ForeignKeyConstraint(
            ["validation_id"], ["annotations.id"], name=op.f("fk_trainings_validation_id_annotations")
        ),
        sa.ForeignKeyConstraint(["model_id"], ["models.id"], name=op.f("fk_trainings_model_id_models")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_trainings")),
    )
    op.create_index("ix_trainings_state", "trainings", ["state"])
    op.create_index("ix_trainings_name", "trainings", ["name"])
    _change_stages(("ingest", "segment", "refine", "publish", "train"), ("segment", "refine", "train"))


def downgrade() -> None:
    op.execute("DELETE FROM stages WHERE name = 'train'")
    op.drop_index("ix_stages_training_id", table_name="stages")
    _change_stages(("ingest", "segment", "refine", "publish"), ("segment", "refine"), back=True)
    op.drop_index("ix_trainings_name", table_name="trainings")
    op.drop_index("ix_trainings_state", table_name="trainings")
    op.drop_table("trainings")
    op.drop_table("annotations")


def _change_stages(names: tuple[str, ...], queues: tuple[str, ...], *, back: bool = False) -> None:
    """Let the table of stages take these names and queues, and a training (``back``: no training any more)."""
    with op.batch_alter_table("stages") as stages:
        for column, kind, values in (("name", "stagename", names), ("queue", "queuename", queues)):
            check = op.f(f"ck_stages_{kind}")
            stages.drop_constraint(check, type_="check")
            stages.create_check_constraint(check, f"{column} IN ({', '.join(repr(value) for value in values)})")
        key = op.f("fk_stages_training_id_trainings")
        if back:
            stages.drop_constraint(key, type_="foreignkey")
            stages.drop_column("training_id")
        else:
            stages.add_column(sa.Column("training_id", sa.String(length=32), nullable=True))
            stages.create_foreign_key(key, "trainings", ["training_id"], ["id"], ondelete="CASCADE")
            stages.create_index("ix_stages_training_id", ["training_id"])
