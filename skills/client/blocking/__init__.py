"""The blocking client; `python -m tests.generated` generates it from the asynchronous one, see `skills.client`."""
