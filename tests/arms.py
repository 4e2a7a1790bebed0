"""Errors of arms for tests: a laboratory's well calibrated arms, and arms that are exactly where they should be."""

from skills.verification.arm_errors import SIZES, ArmErrors

ARMS = ArmErrors(
    name="bench",
    registration_mm=0.3,
    registration_deg=0.1,
    wrist_deg=0.5,
    tip_bias_mm=0.3,
    tip_noise_mm=0.1,
    tip_correlation_s=0.5,
    sources=dict.fromkeys(SIZES, "a test's own arms"),
)
EXACT = ArmErrors("exact", 0, 0, 0, 0, 0, 0, ARMS.sources)
