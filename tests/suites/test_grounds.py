"""Three grounds, one after the other: what is drawn of them."""

from real.grounds import Log, draw, one_drive


def test_the_figure_has_a_line_for_every_predictor_that_it_compares():
    log = one_drive()
    parts = (getattr(log, name)[:24] for name in ("command", "response", "seconds"))
    few = Log(log.names, *parts)
    upper, lower = draw(few).axes
    assert [len(axes.lines) for axes in (upper, lower)] == [6, 6]  # three curves, three grounds
    assert all(len(line.get_xdata()) == 24 for line in upper.lines[:3])
    assert {text.get_text() for text in upper.texts} == {"asphalt", "gravel", "ice"}
