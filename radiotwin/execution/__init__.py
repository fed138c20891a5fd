"""Work in independent pieces: in this process, in others of this machine, or on a Ray cluster."""

from radiotwin.execution.choose import AUTO, open_executor, worker_count
from radiotwin.execution.executor import Executor
from radiotwin.execution.job import Job, Resources

__all__ = ["AUTO", "Executor", "Job", "Resources", "open_executor", "worker_count"]
