"""Tests of the live arm: against a stand-in, on a bus in memory and on a real one."""
