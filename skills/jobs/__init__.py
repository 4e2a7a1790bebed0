"""Durable work: the library's use cases as workflows of a job engine (DBOS Transact), on SQLite or PostgreSQL.

The row of a job in our database is the truth; the engine only sees to it that somebody works on it.

    engine      how both sides reach the engine; `Engine`, through which the service tells it of a job
    workflows   what a worker does with one job: try, try again, give up
    lease       who has fallen silent, whatever the clocks say
    watch       what a worker does between jobs: show that it lives, tell, take over, read back
    warm        the compiled loops, ready before they are needed
    memory      what is freed, kept for the next style
    worker      the worker process
    child       that process as a child of the service
"""
