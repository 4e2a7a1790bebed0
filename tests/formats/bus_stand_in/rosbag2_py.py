"""A stand-in for rosbag2_py: it reads bags with rosbags."""

from pathlib import Path
from types import SimpleNamespace

from rosbags.rosbag2 import Reader


def StorageOptions(uri: str, storage_id: str) -> str:  # noqa: N802 - the name of rosbag2_py
    assert storage_id == "mcap"
    return uri


def ConverterOptions(**_: str) -> None:  # noqa: N802
    return None


class SequentialReader:
    def open(self, uri: str, _: None) -> None:
        with Reader(Path(uri)) as reader:
            self.types = {one.topic: one.msgtype for one in reader.connections}
            self.left = [(one.topic, data, at_ns) for one, at_ns, data in reader.messages()]

    def get_all_topics_and_types(self) -> list[SimpleNamespace]:
        return [SimpleNamespace(name=topic, type=kind) for topic, kind in self.types.items()]

    def has_next(self) -> bool:
        return bool(self.left)

    def read_next(self) -> tuple[str, bytes, int]:
        return self.left.pop(0)
