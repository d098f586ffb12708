"""Alembic's entry: runs on the connection that ``migrate.upgrade`` opened."""

from alembic import context

from l3ps_platform.catalog import Base

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=Base.metadata,
    render_as_batch=True,  # SQLite cannot alter a table in place
)
with context.begin_transaction():
    context.run_migrations()
