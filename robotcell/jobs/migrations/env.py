"""What Alembic runs to migrate: on the connection that `robotcell.jobs.journal_schema` hands it."""

from alembic import context

connection = context.config.attributes["connection"]
context.configure(connection=connection, render_as_batch=True)
with context.begin_transaction():
    context.run_migrations()
connection.commit()
