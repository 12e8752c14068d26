"""Tables in Markdown."""

from collections.abc import Iterable, Sequence


def markdown_table(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """
    :param head: heads of the columns
    :param body: cells of each line below
    :return: the table, without a line break at its end
    """
    lines = (head, ["---"] * len(head), *body)
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
