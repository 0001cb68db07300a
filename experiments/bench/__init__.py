"""The bench of questions about touch: made from records, filtered, annotated, audited, carded."""
