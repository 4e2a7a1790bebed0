"""What crosses HTTP, each way in modules of its own; nothing is loaded here, so that `given` costs a client little.

- `sent`: what comes in; strict, unknown fields are refused.
- `given`: what goes out; models that a client reads with, of the standard library and pydantic alone.
- `written`: what goes out, written from rows.
"""
