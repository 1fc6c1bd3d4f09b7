"""Made-up results of three methods on a small round track."""

import pytest
from laps import LAPS, results, track, write_results


@pytest.fixture
def make_results():
    return results


@pytest.fixture
def laps():
    return LAPS


@pytest.fixture
def store(tmp_path):
    """Write the folder of a run: tables, measures and manifest."""

    def write(name, *tables):
        return write_results(tmp_path / name, *tables)

    return write


@pytest.fixture
def run_folder(store):
    """Write the folder of a run of made-up results."""

    def write(name="run", change=lambda missions: missions, **chosen):
        missions, steps = results(**chosen)
        return store(name, change(missions), steps)

    return write


@pytest.fixture
def ring():
    return track()


@pytest.fixture
def artists():
    """Artists of an axes or figure that carry a name (matplotlib's group id)."""

    def find(where, name):
        return where.findobj(lambda artist: artist.get_gid() == name)

    return find
