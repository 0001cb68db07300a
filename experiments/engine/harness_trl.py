"""TRL's GRPO trainer on the timed job (`job.py`), on the CPU, run by an interpreter that has TRL.

    python3.11 -m venv TRL && TRL/bin/pip install -c constraints.txt trl==1.16.0 torch
    make experiment EXP=speed_grpo ARGS="--trl-python TRL/bin/python"

or, in this project's environment, `pip install -c constraints.txt -e '.[speed]'`.  Functions import TRL, because the
rest of the project does not need it.
"""

import tempfile
import time
from typing import Any

from experiments.engine.peers import BETA, CLIP, LEARNING_RATE, PAD_ID, PeerJob, format_answer, run_harness


def main(job: PeerJob) -> str:
    """Train for the iterations of the job, and return the line to print."""
    import datasets
    import torch
    import transformers
    import trl

    transformers.logging.set_verbosity_error()
    torch.manual_seed(0)
    starts: list[float] = []

    class StepTimer(transformers.TrainerCallback):
        """An iteration runs from one step's begin to the next one's, data included."""

        def on_step_begin(self, *args: Any, **kwargs: Any) -> None:
            starts.append(time.perf_counter())

    def reward(completion_ids: list[list[int]], **kwargs: Any) -> list[float]:
        return [job.reward(tokens) for tokens in completion_ids]

    with tempfile.TemporaryDirectory() as folder:
        save_policy(job, folder)
        rows = [{"prompt": " ".join(map(str, ids))} for batch in job.prompts() for ids in batch]
        trainer = trl.GRPOTrainer(
            model=folder,  # a path, so that the trainer makes its reference from the same weights
            reward_funcs=reward,
            args=trl.GRPOConfig(**settings(job, folder)),
            train_dataset=datasets.Dataset.from_list(rows),
            processing_class=transformers.AutoTokenizer.from_pretrained(folder),
            callbacks=[StepTimer()],
        )
        trainer.train()
    versions = {m.__name__: m.__version__ for m in (trl, torch, transformers)}
    return format_answer(job, starts, versions | {"threads": str(torch.get_num_threads())})


def save_policy(job: PeerJob, folder: str) -> None:
    """A fresh decoder of the job's shape, and a tokenizer whose words are the token ids."""
    import tokenizers
    import transformers

    c = job.size
    config = transformers.Qwen2Config(
        vocab_size=c.vocab_size,
        hidden_size=c.hidden_size,
        intermediate_size=c.intermediate_size,
        num_hidden_layers=c.num_layers,
        num_attention_heads=c.num_heads,
        num_key_value_heads=c.num_kv_heads,
        max_position_embeddings=job.prefix + c.length,
        rope_theta=1e6,
        tie_word_embeddings=True,
        bos_token_id=None,
        eos_token_id=job.end_id,
        pad_token_id=PAD_ID,
    )
    transformers.Qwen2ForCausalLM(config).save_pretrained(folder)
    words = tokenizers.models.WordLevel({str(i): i for i in range(job.end_id + 1)}, unk_token=str(PAD_ID))
    tokenizer = tokenizers.Tokenizer(words)
    tokenizer.pre_tokenizer = tokenizers.pre_tokenizers.WhitespaceSplit()
    transformers.PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token=str(PAD_ID), eos_token=str(job.end_id)
    ).save_pretrained(folder)


def settings(job: PeerJob, folder: str) -> dict[str, Any]:
    """The trainer's arguments: plain GRPO at temperature 1 over the whole vocabulary, one update a step."""
    return {
        "output_dir": folder,
        "use_cpu": True,
        "bf16": False,
        "report_to": "none",
        "save_strategy": "no",
        "logging_steps": 10**6,  # never
        "disable_tqdm": True,
        "max_steps": job.iterations,
        "per_device_train_batch_size": job.size.prompts * job.size.group,
        "gradient_accumulation_steps": 1,
        "gradient_checkpointing": False,
        "num_generations": job.size.group,
        "num_iterations": 1,
        "max_completion_length": job.size.length,
        "temperature": 1.0,
        "top_p": 1.0,
        "top_k": 0,
        "beta": BETA,
        "epsilon": CLIP,
        "loss_type": "grpo",
        "learning_rate": LEARNING_RATE,
        "lr_scheduler_type": "constant",
        "max_grad_norm": 0.0,
        "shuffle_dataset": False,
        "generation_kwargs": {"eos_token_id": job.end_id},
    }


if __name__ == "__main__":
    run_harness(main)
