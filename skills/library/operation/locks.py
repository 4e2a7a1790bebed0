"""The locks of writing transactions on PostgreSQL: the names to pass to `Database.writing`.

    name          what only one transaction at a time may change or rely on
    surgeon       the surgeon with consent and pseudonym; their demonstrations and marks, versions and version numbers,
                  releases, plans and playbacks; the identities of the jobs for them
    recording     the bytes, their reading parameters, the cached content, the uploads, the demonstrations cut from it
    job           the state of a job; of a batch also its parts and styles
    batches       the identities of batches
    distances     the cached measurements of the atlas
    sign-ins      the sign-ins of browsers
    sweep         chunks without a recording, jobs of erased surgeons

Whoever asks for consent and stores holds the name of the surgeon meanwhile, and so does whoever changes the consent.
What is not in the table, or touches many surgeons, names nothing and so runs alone: erasures, keys, suture types,
calibrations, exports, restoring. What is unique is so by constraints of the tables too.

A caller who has only a digest looks up the surgeon before the transaction: a demonstration never changes its surgeon,
and where it was erased since, the transaction finds nothing.
"""

BATCHES, DISTANCES, SIGN_INS, SWEEP = "batches", "distances", "sign-ins", "sweep"


def surgeon(slug: str) -> str:
    """Return the name of a surgeon, by pseudonym."""
    return f"surgeon {slug}"


def recording(sha256: str) -> str:
    """Return the name of a recording, by the SHA-256 of its bytes in full."""
    return f"recording {sha256}"


def job(row: int) -> str:
    """Return the name of a job."""
    return f"job {row}"
