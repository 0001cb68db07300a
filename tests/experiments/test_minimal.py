import re

import pytest

from experiments import minimal


@pytest.mark.slow
def test_the_page_learns_to_answer_about_unseen_objects():
    lines: list[str] = []
    minimal.main(lines.append)
    scores = [line for line in lines if line.startswith("after")]
    assert len(scores) == 2
    for line in scores:
        low = float(re.search(r"\[(-?[\d.]+), ", line)[1])
        assert low > 0, f"not better than a constant: {line}"
