from roel_service.service.metrics import Counter, Gauge, Histogram, exposition


def test_a_counter_is_told_for_each_of_its_labels():
    counter = Counter(name="calls_total", help="Calls.", label_names=("method", "code"))
    counter.add("/a", "OK")
    counter.add("/a", "OK", amount=2)
    counter.add("/a", 'with "quotes"\nand \\')
    assert exposition([counter]) == (
        "# HELP calls_total Calls.\n"
        "# TYPE calls_total counter\n"
        'calls_total{method="/a",code="OK"} 3\n'
        'calls_total{method="/a",code="with \\"quotes\\"\\nand \\\\"} 1\n'
    )


def test_a_gauge_is_read_when_it_is_told():
    values = {(): 1.5}
    gauge = Gauge(name="depth", help="Depth.", read=lambda: values)
    assert exposition([gauge]).endswith("\ndepth 1.5\n")
    values[()] = 12_345_678_901
    assert exposition([gauge]).endswith("\ndepth 12345678901\n")


def test_buckets_count_all_values_up_to_their_bounds():
    histogram = Histogram(name="s", help="Seconds.", label_names=("m",), bounds=(0.1, 1.0))
    for value in (0.05, 0.1, 0.5, 7.0):
        histogram.observe("a", value=value)
    assert list(histogram.lines())[2:] == [
        's_bucket{m="a",le="0.1"} 2',
        's_bucket{m="a",le="1"} 3',
        's_bucket{m="a",le="+Inf"} 4',
        's_sum{m="a"} 7.65',
        's_count{m="a"} 4',
    ]
