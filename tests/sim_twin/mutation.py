"""Files that are nearly valid."""

from hypothesis import strategies as st


def mutated(data, text, intruders):
    """The text with one to three of its words or lines left out, doubled, or replaced by one of the intruders."""
    for _ in range(data.draw(st.integers(1, 3))):
        separator = data.draw(st.sampled_from([" ", "\n"]))
        pieces = text.split(separator)
        i = data.draw(st.integers(0, len(pieces) - 1))
        pieces[i : i + 1] = data.draw(st.sampled_from([[], [pieces[i]] * 2, *([word] for word in intruders)]))
        text = separator.join(pieces)
    return text
