"""Encoded responses of policies, cached under the digest of the policy and the identity of its release."""

from collections.abc import Callable, Collection

from skills.api.responses import JSON, Body, json_of, negotiate, tag_of
from skills.db.history import History
from skills.db.models import PolicyVersion, Release
from skills.db.weighted_cache import WeightedCache
from skills.library.operation.proofs import sign_files
from skills.library.policies import answers
from skills.library.policies.pose_styles import describe_pose_style, has_poses, poses_of
from skills.settings import MEBIBYTE
from skills.transparency.notes import Note

NPZ = "application/x-npz"
FORMATS = ("A policy", JSON, NPZ)  # for `negotiate`
KEPT_BYTES = 64 * MEBIBYTE  # capacity of the cache; a policy's JSON is about 50 kB, with a million actions 3 MB


class Encoded:
    """LRU cache of encoded policy responses, keyed by everything that their content depends on."""

    def __init__(self) -> None:
        self._kept: WeightedCache[tuple[object, ...], Body] = WeightedCache(KEPT_BYTES, lambda body: len(body.content))

    def policy(self, policy: PolicyVersion, release: Release | None, accept: str) -> Body:
        """Return the encoded response of a policy version and its release, from the cache if it is there."""
        media_type = negotiate(accept, *FORMATS)
        # With their times, because row and version numbers are used again after an erasure.
        released = (release.row, release.released_at) if release else None
        poses = policy.poses.sha256 if policy.poses else None
        key = (policy.sha256, policy.version, policy.created_at, released, poses, media_type)
        return self._cached(key, lambda: _encode(policy, release, media_type))

    def pose_style(self, policy: PolicyVersion) -> Body:
        """Return the encoded pose style of a policy version, from the cache if it is there."""
        key = (policy.sha256, policy.version, policy.created_at, policy.poses.sha256 if policy.poses else None)
        return self._cached(key, lambda: _json_body(json_of(describe_pose_style(policy, poses_of(policy)))))

    def signature(self, release: Release, head: Note, history: History) -> Body:
        """Return the signature of the responses of a released policy, each as it is sent; they are encoded for it.

        Args:
            release: The release.
            head: A checkpoint of the history that covers both.
            history: The history, with the key.
        """
        policy = release.policy
        bodies = {
            "policy.json": self.policy(policy, release, JSON),
            "policy-version.json": self.policy(policy, None, JSON),
            "policy.npz": self.policy(policy, release, NPZ),
        }
        if has_poses(policy):
            bodies["pose-style.json"] = self.pose_style(policy)
        digests = {name: body.etag.strip('"') for name, body in bodies.items()}
        facts = {"surgeon": policy.surgeon.slug, "suture": policy.suture, "version": policy.version}
        return _json_body(sign_files(history, head, digests, kind="policy", policy=policy.sha256, **facts))

    def _cached(self, key: tuple[object, ...], encode: Callable[[], Body]) -> Body:
        body = self._kept.get(key)
        if body is None:
            body = encode()
            self._kept.put(key, body)
        return body

    def policies(self) -> set[str]:
        """Return the digests of the policies with cached responses."""
        return {str(key[0]) for key, _ in self._kept.items()}

    def forget(self, policies: Collection[str]) -> None:
        """Remove the cached responses of these policies."""
        self._kept.forget([key for key, _ in self._kept.items() if key[0] in policies])


def _json_body(content: bytes) -> Body:
    return Body(content, JSON, tag_of(content))


def _encode(policy: PolicyVersion, release: Release | None, media_type: str) -> Body:
    if media_type == NPZ:
        content = answers.arrays_of(policy)
    else:
        arrays = f"/policy-versions/{policy.sha256} with Accept: {NPZ}"
        content = json_of(answers.describe_policy(policy, release, arrays))
    # A header and no field, so that the bytes and the ETag stay those of the policy.
    linked = release is not None and policy.poses is not None
    link = f'<{policy.suture}/pose-style>; rel="related"; title="pose style"' if linked else None
    return Body(content, media_type, tag_of(content), link)
