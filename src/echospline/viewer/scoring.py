"""Scores, as the page that simulates has them."""

from echospline.page.scoring import Score, redirections, score, smoothness

__all__ = ["Score", "redirections", "score", "smoothness"]
