"""Durable background jobs: the library's use cases as workflows of a job engine, DBOS Transact.

The engine stores its workflows in SQLite or PostgreSQL. The row of a job in our database is authoritative; the engine
only makes sure that a worker processes it.

    engine      access to the engine for both sides; `Engine`, with which the service enqueues jobs
    workflows   the workflow of one job: try, retry, give up; and the watch, a worker's periodic tasks: leases and
                heartbeats, enqueueing, taking over from dead workers, reading back outcomes
    readiness   checks of the database, the engine and the workers, for health checks; and the warm-up, which compiles
                or loads the compiled loops before they are needed
    worker      the worker process; `skills.serving` starts it as a child of the service
"""
