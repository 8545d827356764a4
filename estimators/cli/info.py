"""`rtac info`: what is in a recording."""

import typer

from estimators.cli.job import load
from estimators.cli.options import File, Json
from estimators.cli.output_files import writable_file
from estimators.cli.refusals import answering

_GUARDED = "checksums: the file is as it was written."
_UNGUARDED = "checksums: none, so nothing guards the numbers against damage to the file; Recording.load(...).save(...) adds them."


def info(file: File, json: Json = None) -> None:
    """Describe what is in a recording, and what looks wrong with it."""
    with answering():
        from estimators.validation.channel_consistency import channel_consistency
        from rtac_jax import RTAC
        from rtac_jax.constants import require_constants
        from rtac_jax.measurement import concerns, describe, guarded_by_digest

        if json is not None:
            writable_file(json, "--json")
        recording = load(file)
        found, guarded = concerns(recording) + channel_consistency(recording).concerns, guarded_by_digest(file)
        try:
            require_constants(RTAC.paper(), recording.rig)
        except ValueError as error:  # a fit refuses them
            found.append(str(error))
        if json is not None:
            from estimators.reporting.html import write_json
            from estimators.reporting.recording import recording_dict

            write_json(json, recording_dict(recording, found, guarded=guarded))
        typer.echo(describe(recording))
        typer.echo(f"\n{_GUARDED if guarded else _UNGUARDED}")
        typer.echo("\nconcerns:" if found else "\nconcerns: none")
        for sentence in found:
            typer.echo(f"- {sentence}")
