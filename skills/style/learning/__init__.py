"""Learners: how a reward map becomes Q values."""
