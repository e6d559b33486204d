"""Exercises, as the page that simulates has them."""

from echospline.page.exercise import Disc, Exercise, check_exercises, default_exercises

__all__ = ["Disc", "Exercise", "check_exercises", "default_exercises"]
