"""How unfamiliar a shape is: how seldom it shares a leaf with the views the model knows."""

import numpy as np

from shapecat.arrays import I4, U2, U4, Record, array
from shapecat.jit import kernel

__all__ = ["LeafProximity", "share_leaves"]


class LeafProximity(Record):
    """Known views by the words they contain: an inverted index.

    The proximity of two views is the share of trees in which they fall into the same leaf
    (Breiman 2001). Novelty is 1 minus the mean proximity to the ``neighbours`` nearest known
    views, divided by ``threshold``: above 1 a shape is unknown.

    Attributes
    ----------
    starts : (w,) ``members[starts[k]:starts[k + 1]]`` contain word k; one more than words.
    members : (m,) numbers of known views.

    Raises
    ------
    ValueError : starts or members that do not fit.
    """

    starts: U4 = array("w", "u4")
    members: U2 = array("m", "u2")
    views: int
    neighbours: int
    threshold: float

    def __post_init__(self) -> None:
        """Check that every index may be used without another look."""
        super().__post_init__()
        starts = self.starts.astype(np.int64)
        good = (
            starts.size >= 1
            and starts[0] == 0
            and starts[-1] == self.members.size
            and bool(np.all(np.diff(starts) >= 0))
            and bool(np.all(self.members < self.views))
            and 1 <= self.neighbours <= 10_000
            and 0 <= self.views <= 0xFFFF
            and np.isfinite(self.threshold)
            and self.threshold > 0
        )
        if not good:
            msg = "the index of known views is damaged"
            raise ValueError(msg)

    @classmethod
    def of(
        cls, words: I4, *, vocabulary: int, neighbours: int, threshold: float = 1.0
    ) -> "LeafProximity":
        """Index known views by their words (n, t)."""
        flat = words.reshape(-1)
        order = np.argsort(flat, kind="stable")
        starts = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=vocabulary))])
        owner = np.arange(words.size) // words.shape[1]
        return cls(starts, owner[order], len(words), neighbours, threshold)

    @property
    def parameters(self) -> tuple[np.ndarray, ...]:
        """The arrays of `share_leaves`, in the types of the kernel."""
        return self.starts.astype(np.int64), self.members.astype(np.int64)

    def words_of_views(self, trees: int) -> I4:
        """Return the words of the known views: (views, trees), ascending by tree."""
        word = np.repeat(np.arange(self.starts.size - 1), np.diff(self.starts))
        order = np.argsort(self.members, kind="stable")
        return word[order].reshape(self.views, trees)

    def novelty(self, words: I4) -> np.ndarray:
        """Return the novelty of views with these words (n, t): (n,)."""
        counts = np.zeros(self.views, np.int64)
        score = [share_leaves(row, *self.parameters, counts, self.neighbours) for row in words]
        return np.array(score, np.float32).reshape(len(words)) / np.float32(self.threshold)


@kernel
def share_leaves(words: I4, starts: I4, members: I4, counts: I4, neighbours: int) -> float:
    """Return 1 minus the mean proximity of a view with words (t,) to its nearest known views.

    ``counts`` (views,) is all zero before and after.
    """
    trees = words.size
    histogram = np.zeros(trees + 1, np.int64)
    for word in words:
        for k in range(starts[word], starts[word + 1]):
            counts[members[k]] += 1
    for word in words:
        for k in range(starts[word], starts[word + 1]):
            shared = counts[members[k]]
            histogram[shared if shared < trees else trees] += 1 if shared > 0 else 0
            counts[members[k]] = 0
    total, left = 0, neighbours
    for shared in range(trees, 0, -1):
        used = histogram[shared] if histogram[shared] < left else left
        total += used * shared
        left -= used
    return 1.0 - total / (trees * neighbours)
