"""Size of the job that GRPO engines are timed on; plain Python, for the interpreters of the peers read it too."""

import dataclasses

BETA = 0.04
"""Weight of the KL to the reference policy."""

LEARNING_RATE = 1e-4


@dataclasses.dataclass(frozen=True, kw_only=True)
class JobSize:
    """Prompts, rollouts of each, new tokens, and the decoder."""

    prompts: int = 8
    group: int = 8
    length: int = 64
    vocab_size: int = 512
    hidden_size: int = 128
    num_layers: int = 4
    num_heads: int = 4
    num_kv_heads: int = 2
    head_dim: int = 32
    intermediate_size: int = 512

    def gflop(self, prefix: int, beta: float = BETA) -> float:
        """Multiplications and additions of matrix products that one iteration needs, in 10⁹.

        The prefix once a prompt and pass: sampling, forward and backward (thrice the forward), reference.
        """
        c = self
        weights = c.num_layers * (
            2 * c.hidden_size * c.num_heads * c.head_dim
            + 2 * c.hidden_size * c.num_kv_heads * c.head_dim
            + 3 * c.hidden_size * c.intermediate_size
        )
        pair = 2 * c.num_layers * c.num_heads * c.head_dim  # q·k and weights·v of one query and key
        prompt = prefix * weights + pair * prefix * (prefix + 1) / 2
        seen = self.length * prefix + self.length * (self.length + 1) / 2
        completion = self.length * (weights + c.hidden_size * c.vocab_size) + pair * seen
        passes = 1 + 3 + (beta > 0)
        return 2 * passes * self.prompts * (prompt + self.group * completion) / 1e9
