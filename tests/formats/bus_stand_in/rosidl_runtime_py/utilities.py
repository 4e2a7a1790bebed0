"""A stand-in: a message type is its name."""


def get_message(name: str) -> str:
    return name
