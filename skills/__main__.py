"""Entry point of `python -m skills`: the command line."""

from skills.cli import app

app()
