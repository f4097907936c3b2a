"""A push keeps its end, an action the height above the table, an outcome the force of the fingers."""

import json

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Change the tables; heights above the table follow from the table's height in each job's configuration."""
    with op.batch_alter_table("actions") as actions:
        actions.add_column(sa.Column("surface_m", sa.Float(), nullable=False, server_default="0"))
        actions.add_column(sa.Column("end_x", sa.Float()))
        actions.add_column(sa.Column("end_y", sa.Float()))
    connection = op.get_bind()
    for job_id, config in connection.execute(sa.text("SELECT id, config FROM jobs")).all():
        values = json.loads(config) if isinstance(config, str) else config
        connection.execute(
            sa.text("UPDATE actions SET surface_m = z - :table WHERE job_id = :job"),
            {"table": values["table"]["height_m"], "job": job_id},
        )
    with op.batch_alter_table("actions") as actions:
        for name in ("row", "col", "z"):
            actions.drop_column(name)
        actions.alter_column("surface_m", existing_type=sa.Float(), existing_nullable=False, server_default=None)
    with op.batch_alter_table("outcomes") as outcomes:
        outcomes.add_column(sa.Column("grip_force_n", sa.Float()))
        outcomes.alter_column("peak_force_n", existing_type=sa.Float(), nullable=True)
