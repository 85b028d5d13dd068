"""The command line: ``motorid fit RUN...`` and its fellows."""

from typing import Annotated

import typer

from motorid.cli import bench, diagnose, fit
from motorid.cli.console import Command, Group, prepare_process
from motorid.numerics.parallel import interruption
from motorid.records.files import package_version

app = typer.Typer(cls=Group, add_completion=False, rich_markup_mode="rich", pretty_exceptions_enable=False,
                  context_settings={"help_option_names": ["-h", "--help"]})


@app.callback(invoke_without_command=True)
def motorid(context: typer.Context,
            version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False) -> None:
    """Identify brushed DC motors: fit a model to records, see where it fails, add the effect that is missing.

    Start with: motorid demo"""
    if version:
        typer.echo(f"motorid {package_version('motorid')}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


for _command in (diagnose.demo_command, fit.check_command, fit.effects_command, fit.fit_command, fit.simulate_command,
                 diagnose.diagnose_command, diagnose.design_command, fit.identifiability_command,
                 fit.robustness_command, fit.fit_many_command, fit.export_command,
                 bench.record_command, bench.bench_command):
    app.command(_command.__name__.removesuffix("_command").replace("_", "-"), cls=Command)(_command)


def main() -> None:
    """Run the command line; leaves by `SystemExit`."""
    prepare_process()
    try:
        app()
    finally:
        interruption.over()
