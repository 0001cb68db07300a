"""Stage 1: pretraining of the tactile encoder, what it learned, how fast it runs, frames that it lets one predict."""
