from collections import Counter

import pytest


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say what was not tested and why: an absence is printed, never silent."""
    skipped = [report.longrepr for report in terminalreporter.stats.get("skipped", ())]
    reasons = Counter(where_and_why[2] for where_and_why in skipped if isinstance(where_and_why, tuple))
    for reason, count in reasons.items():
        terminalreporter.write_line(f"{count} NOT TESTED - {reason}", yellow=True, bold=True)
