"""The tables of the first journals, which noted no revision."""

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Nothing: these tables are there."""
