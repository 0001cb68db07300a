"""Qwen2.5-VL (arXiv 2502.13923) and dense Qwen3-VL (arXiv 2511.21631): towers, published weights, and a policy."""
