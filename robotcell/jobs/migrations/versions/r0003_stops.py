"""Stops outlive the process, a job names its owner, and an action what it was for and what it held."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Add the table and the columns; what older journals do not tell is null."""
    op.create_table(
        "stops",
        sa.Column("id", sa.Integer(), primary_key=True),
        sa.Column("cell", sa.String(), nullable=False),
        sa.Column("what", sa.String(), nullable=False),
        sa.Column("at", sa.DateTime(), nullable=False),
        sa.Column("q", sa.JSON()),
        sa.Column("job_id", sa.Integer(), sa.ForeignKey("jobs.id")),
        sa.Column("cleared", sa.DateTime()),
    )
    with op.batch_alter_table("jobs") as jobs:
        jobs.add_column(sa.Column("lock", sa.String()))
        jobs.add_column(sa.Column("owner", sa.String()))
    with op.batch_alter_table("actions") as actions:
        actions.add_column(sa.Column("task", sa.String()))
        actions.add_column(sa.Column("held", sa.String()))
