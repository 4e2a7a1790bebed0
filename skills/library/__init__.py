"""The use cases, between the database and whoever asks.

A function that takes a `session` joins its caller's transaction. One that takes a `database` is slow: it reads, lets
go, computes, and writes in a short transaction of its own.
"""

from skills.library.work import perform_job

__all__ = ["perform_job"]
