"""The patient-side manipulator in PyBullet, in a process of its own; importing this does not need PyBullet."""
