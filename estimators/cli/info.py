"""`rtac info`: what is in a recording."""

import typer

from estimators.cli.job import answering, load
from estimators.cli.options import File

_GUARDED = "checksums: the file is as it was written."
_UNGUARDED = "checksums: none, so nothing guards the numbers against damage to the file; Recording.load(...).save(...) adds them."


def info(file: File) -> None:
    """Describe what is in a recording, and what looks wrong with it."""
    with answering():
        from estimators.validation.channel_consistency import channel_consistency
        from rtac_jax.measurement import concerns, describe, guarded_by_digest

        recording = load(file)
        typer.echo(describe(recording))
        typer.echo(f"\n{_GUARDED if guarded_by_digest(file) else _UNGUARDED}")
        found = concerns(recording) + channel_consistency(recording).concerns
        typer.echo("\nconcerns:" if found else "\nconcerns: none")
        for sentence in found:
            typer.echo(f"- {sentence}")
