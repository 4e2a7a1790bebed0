"""Schemas of everything that crosses HTTP, declared once and used by the API and the client.

- `requests`: request bodies; strict, unknown fields are refused. The library takes them as they are.
- `given`: responses. Their parts are in `recordings`, `policies`, `plans` and `comparison`, their common base in
  `base`. A part that is a value of the domain is declared there, as a dataclass with `skills.fields.schema`.

The library writes the JSON of a response, next to the use case of its noun (`plan_json` in `library/plans.py`). Rows
store most of it as it was computed, so an older row is answered as it was, and not forced into today's fields.
"""
