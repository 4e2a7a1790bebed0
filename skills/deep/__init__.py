"""The learners beyond the table: environments, and what learns in them, with torch.

`learn_policy` learns with any learner there is. torch is the extra `deep`: it is imported in the process that learns
and nowhere else, so that a service starts without it, and serves what was learnt elsewhere.
"""

from skills.deep.learning import learn_policy, require_installed

__all__ = ["learn_policy", "require_installed"]
