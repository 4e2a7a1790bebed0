"""Loading the sample surgeons into a service, as a lab would load its own."""

import tomllib
from collections.abc import Iterator
from importlib import resources

from skills.api.schemas.given import Demonstration
from skills.client import Client
from skills.seeds.recordings import sample_recordings


def load_samples(client: Client) -> Iterator[Demonstration]:
    """Store the synthetic surgeons and every hand-off that the service proposes in their recordings."""
    text = (resources.files("skills") / "seeds" / "surgeons.toml").read_text()
    for surgeon in tomllib.loads(text)["surgeon"]:
        client.put_surgeon(surgeon["slug"], skill_level=surgeon["skill_level"], handedness=surgeon["handedness"])
    for sample in sample_recordings():
        stored = client.add_recording(sample.data)
        for part in stored.segments:
            yield client.cut_demo(
                stored.sha256,
                surgeon=sample.surgeon,
                suture=sample.suture,
                arm=part.arm,
                start_s=part.start_s,
                end_s=part.end_s,
            )
