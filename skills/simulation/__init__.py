"""The patient-side manipulator in PyBullet, in a separate process; importing this does not require PyBullet."""
