"""Which photos and pairs need a second look."""

import itertools

from hypothesis import given
from hypothesis import strategies as st

from jaxsfm.core.types import Status
from jaxsfm.io.pairs import PairCounts
from jaxsfm.sfm.second_look import CLOSEST, MOST_UNSETTLED, second_look

NAMES = [f"{k:02d}" for k in range(20)]
PAIRS = list(itertools.combinations(NAMES, 2))


def counted(inliers: dict | None = None, tentative: dict | None = None) -> dict:
    """The counts of all pairs: some with inliers, some with other numbers of tentative matches."""
    return {
        pair: PairCounts(
            (inliers or {}).get(pair, 0), 0, (tentative or {}).get(pair, 0), 0, Status(0)
        )
        for pair in PAIRS
    }


def test_nothing_is_looked_at_again_where_all_photos_are_settled():
    assert second_look(counted(), NAMES, NAMES, []) is None


def test_everything_is_looked_at_again_where_no_photo_is_settled():
    again = second_look(counted(), NAMES, [], [])
    assert again is not None and again.whole
    assert again.pairs == PAIRS and again.photos == NAMES


def test_everything_is_looked_at_again_where_more_than_a_third_of_the_photos_have_no_place():
    most = int(MOST_UNSETTLED * len(NAMES))
    for count, whole in ((most, False), (most + 1, True)):
        again = second_look(counted(), NAMES, NAMES[count:], [])
        assert again is not None and again.whole == whole and again.photos == NAMES[:count]


def test_of_several_places_only_the_pairs_of_unsettled_photos_are_looked_at_again():
    """If at least half of the photos are settled. A trusted pair between settled photos is looked
    at again if both came closest to the same unsettled one."""
    lost, settled = NAMES[10:], NAMES[:10]
    inliers = {(a, b): 9 for a, b in PAIRS if a in lost}  # they came closest to each other
    first, second, third = NAMES[:3]
    inliers |= {(first, lost[0]): 10, (second, lost[0]): 10, (third, lost[1]): 10}
    trusted = [(first, second), (first, third), (second, third)]
    own = [pair for pair in PAIRS if not set(settled) >= set(pair)]
    again = second_look(counted(inliers), NAMES, settled, trusted, places=True)
    assert again is not None and again.photos == lost and not again.whole
    assert again.pairs == sorted([(first, second), *own])
    everything = second_look(counted(inliers), NAMES, settled[1:], trusted, places=True)
    assert everything is not None and everything.whole


def test_few_unsettled_photos_are_looked_at_again():
    again = second_look(counted(), NAMES, NAMES[:17], [])
    assert again is not None and again.photos == NAMES[17:] and not again.whole


def test_a_photo_is_looked_at_again_with_those_it_came_closest_to():
    """First by inliers, then by tentative matches, then by name."""
    lost, inliers, tentative = NAMES[-1], {}, {}
    pairs = [(name, lost) for name in NAMES[:-1]]
    inliers[pairs[12]] = 30
    tentative |= {pairs[11]: 9, pairs[14]: 8}
    again = second_look(counted(inliers, tentative), NAMES, NAMES[:-1], [])
    assert again is not None
    rest = [pair for k, pair in enumerate(pairs) if k not in (11, 12, 14)]
    assert again.pairs == sorted([pairs[12], pairs[11], pairs[14], *rest[: CLOSEST - 3]])


@given(trusted=st.sets(st.sampled_from(PAIRS)))
def test_trusted_pairs_between_the_closest_photos_are_looked_at_again(trusted):
    """Their keypoints of the second look give the points that the photo must see."""
    again = second_look(counted(), NAMES, NAMES[:-1], trusted)
    assert again is not None
    near = {*NAMES[:CLOSEST], NAMES[-1]}
    own = {(name, NAMES[-1]) for name in NAMES[:CLOSEST]}
    assert set(again.pairs) == own | {pair for pair in trusted if set(pair) <= near}
    assert again.pairs == sorted(again.pairs)
