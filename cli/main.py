"""The entry point: a group of commands that prints a known error as a single line."""

import errno
import logging
import sys
from typing import Any

import click

from shapecat import __version__
from shapecat.errors import ShapecatError, shortage
from shapecat.system.stopping import Stopped, handling_signals

from .annotate import annotate
from .compare import compare
from .evaluate import evaluate
from .export import export
from .info import info
from .learn import learn
from .options import verbose_option
from .process import process
from .render import discard_stdout
from .report import report
from .scene import scene
from .simulate import simulate
from .train import train
from .view import view


class _Commands(click.Group):
    """Prints known errors as one line and uses their exit codes; other exceptions are bugs."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            with handling_signals():
                return super().invoke(ctx)
        except ShapecatError as error:
            click.echo(f"Error: {error}", err=True)
            ctx.exit(error.exit_code)
        except Stopped as stopped:
            resumable = ctx.invoked_subcommand == "process"
            hint = "; finished work is kept; run the same command again to continue"
            click.echo(f"stopped{hint if resumable else ''}", err=True)
            ctx.exit(stopped.exit_code)
        except Exception as error:
            if not (text := shortage(error)):
                raise
            click.echo(f"Error: {text}", err=True)
            ctx.exit(1)

    def main(self, *args: Any, **extra: Any) -> Any:
        try:
            return super().main(*args, **extra)
        except OSError as error:  # writing stdout failed: other errors name a file
            if error.errno != errno.ENOSPC or error.filename is not None:
                raise
            click.echo(f"Error: cannot write the output: {error.strerror}", err=True)
            discard_stdout()
            sys.exit(1)

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002  click's signature
        return list(self.commands)  # in the order of use, not of the alphabet


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__)
@verbose_option
def main() -> None:
    """Turn robot recordings into reviewed, labelled 3D objects.

    \b
    shapecat simulate demo.mcap               make a recording to try shapecat on
    shapecat process demo.mcap --out results  find, categorize and track objects
    shapecat view results/demo                review them in Rerun
    """
    logging.basicConfig(level=logging.ERROR, stream=sys.stderr, format="%(levelname)s %(message)s")


for _command in (
    info,
    process,
    report,
    annotate,
    view,
    scene,
    export,
    learn,
    train,
    evaluate,
    compare,
    simulate,
):
    main.add_command(_command)
