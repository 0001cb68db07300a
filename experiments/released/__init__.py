"""Released Qwen2.5-VL weights as the policy of a study: loaded, trained by adapters, written back."""
