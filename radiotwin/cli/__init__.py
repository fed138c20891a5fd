"""The command `radiotwin`."""

from radiotwin import signals


def main() -> None:
    """Run the command line and end the process; see `exit_status`."""
    signals.handle()  # before anything that takes time
    from radiotwin.cli.commands import app
    from radiotwin.exits import exit_status
    from radiotwin.interruption import after_interrupt

    signals.leave(exit_status(app, after_interrupt))
