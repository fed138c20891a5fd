"""Work in independent pieces: in this process, in others of this machine, or on a Ray cluster."""

from radiotwin.runtime.execution.executor import AUTO, Executor, open_executor, worker_count
from radiotwin.runtime.execution.job import Job, Resources

__all__ = ["AUTO", "Executor", "Job", "Resources", "open_executor", "worker_count"]
