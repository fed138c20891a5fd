"""The command `radiotwin`."""

from radiotwin import signals


def main() -> None:
    """Run the command line and end the process; see `exit_status`."""
    signals.handle()  # before anything that takes time
    from radiotwin.cli.commands import app
    from radiotwin.exits import exit_status

    signals.leave(exit_status(app, "finished parts are kept; run the same command again to go on"))
