"""The use cases, between the database and its callers, by noun.

A function that takes a `session` joins its caller's transaction. One that takes a `database` is slow: it reads in a
transaction, closes it, computes, and writes in a short transaction at the end.
"""
