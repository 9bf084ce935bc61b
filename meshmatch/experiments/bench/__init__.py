"""Accuracy, honesty and speed on the evaluation data and on generated shapes, each a command."""
