"""Network learners: Gymnasium environments, and training with torch in a separate process.

`learn_policy` learns with any learner. torch is the extra `deep`: it is imported only in the process that trains, so
that a service starts without it, and serves policies that were learnt elsewhere.
"""

from skills.deep.learning import learn_policy, require_installed

__all__ = ["learn_policy", "require_installed"]
