"""`python -m jaxbelt`, which is the command `jaxbelt`."""

from .cli import app

app()
