"""The search loop, with a toy: guess a secret integer; models are (answer, score) pairs, and settle to these."""

import time
from dataclasses import dataclass, field

import pytest
from worlds.scenes import search

from roadgeo.matching.search import Search, SearchOptions, search_each, search_together


@dataclass
class Toy:
    """Rounds of models."""

    plan: list[list[tuple[int, float]]]
    seconds: float = 0.0
    scored: list[int] = field(default_factory=list)
    before: float = 0.0

    @property
    def work(self):
        return self.before + len(self.scored)

    def stages(self):
        yield iter(self.plan)

    def settle(self, model):
        time.sleep(self.seconds)
        self.scored.append(model[0])
        return model


def answer(result):
    return result.best


@pytest.mark.parametrize("plan", [[], [[]], [[], []]])
def test_nothing_to_score(plan):
    result = search(Toy(plan))
    assert answer(result) is None
    assert result.score == float("-inf")
    assert result.stopped == "exhausted"


def test_stops_after_the_round_in_which_one_stands_out():
    toy = Toy([[(1, 3.0)], [(2, 30.0), (50, 4.0)], [(70, 99.0)]])
    result = search(toy)
    assert toy.scored == [1, 2, 50]
    assert (answer(result), result.score) == (2, 30.0)
    assert result.stopped == "accepted"


@pytest.mark.parametrize("per_round", [1, 100])
def test_time_is_bounded(per_round):
    models = [(k, 1.0) for k in range(100)]
    toy = Toy([models[i : i + per_round] for i in range(0, 100, per_round)], seconds=0.005)
    started = time.perf_counter()
    result = search(toy, SearchOptions(time_limit_s=0.03))
    assert time.perf_counter() - started < 2.0
    assert result.stopped == "time"
    assert 0 < len(toy.scored) < 50


@pytest.mark.parametrize("per_round", [1, 100])
@pytest.mark.parametrize("seconds", [0.0, 0.005])
def test_work_is_bounded_by_counts_not_by_the_clock(per_round, seconds):
    """On a busy machine a limit by the clock alone struck earlier, and another answer came of it."""
    models = [(k, 1.0 + k / 100) for k in range(100)]
    toy = Toy([models[i : i + per_round] for i in range(0, 100, per_round)], seconds=seconds)
    result = search(toy, SearchOptions(work_limit_s=20.0, time_limit_s=60.0))
    assert (result.stopped, len(toy.scored)) == ("work", 20)
    assert answer(result) == 19


def test_a_usual_search_takes_some_ten_seconds_of_work_or_a_minute_by_the_clock(monkeypatch):
    usual, seconds = SearchOptions(), 0.0
    toy = Toy([[(k, 1.0)] for k in range(100)])
    assert search(toy, usual).stopped == "work"
    assert 7 < len(toy.scored) < 15

    class Idle(Toy):
        work = 0.0

        def settle(self, model):
            nonlocal seconds
            seconds += 5.0
            return super().settle(model)

    monkeypatch.setattr("roadgeo.matching.search.time.perf_counter", lambda: seconds)
    toy = Idle([[(k, 1.0)] for k in range(100)])
    assert search(toy, usual).stopped == "time"
    assert 40.0 < seconds < 90.0


@pytest.mark.parametrize(("score", "stopped"), [(5.0, "exhausted"), (12.0, "accepted")])
def test_a_usual_search_ends_where_a_model_scores_8(score, stopped):
    assert search(Toy([[(1, score)], [(2, 1.0)]])).stopped == stopped


def test_parts_share_the_work():
    toys = [Toy([[(100 * n + k, 1.0)] for k in range(50)]) for n in range(3)]
    parts = together(*toys, options=SearchOptions(work_limit_s=30.0))
    assert [len(toy.scored) for toy in toys] == [10, 10, 10]
    assert [part.stopped for part in parts] == ["work"] * 3


def test_impossible_models_lose_to_any_other():
    result = search(Toy([[(1, float("-inf")), (50, -3.0)]]))
    assert answer(result) == 50
    assert result.score == -3.0


# --- many parts -------------------------------------------------------------------------------------------------------


class InStages(Toy):
    """The same, with one round a stage."""

    def stages(self):
        for models in self.plan:
            yield iter([models])


def together(*toys, options=None, proves=None):
    parts = [Search(toy) for toy in toys]
    search_together(parts, options, proves)
    return parts


def test_an_answer_that_is_proved_ends_the_search_with_its_stage():
    asked = []

    def proves(parts):
        best = max(parts, key=lambda item: item.score)
        asked.append(answer(best))
        return best if asked[-1] == 21 else None

    toys = [InStages([[(1, 1.0)], [(2, 1.5)], [(3, 1.0)]]), InStages([[(11, 0.5)], [(21, 2.0)], [(31, 30.0)]])]
    parts = together(*toys, proves=proves)
    assert asked == [1, 21]  # once a stage, of all parts
    assert [toy.scored for toy in toys] == [[1, 2], [11, 21]]
    assert [part.stopped for part in parts] == ["elsewhere", "accepted"]


def test_what_stands_out_and_is_not_proved_does_not_end_the_search():
    """It may be the place, fitted to a part of the frame only: a better version may come."""
    toy = Toy([[(1, 30.0)], [(2, 31.0)], [(3, 1.0)]])
    (item,) = together(toy, proves=lambda parts: parts[0] if parts[0].score > 30.0 else None)
    assert (toy.scored, item.stopped) == ([1, 2], "accepted")


def test_parts_take_turns_and_an_answer_that_stands_out_ends_all():
    toys = [Toy([[(10 * n + k, 1.0)] for k in range(5)]) for n in range(3)]
    toys[1].plan[2] = [(17, 30.0)]
    parts = together(*toys)
    assert [len(toy.scored) for toy in toys] == [3, 3, 3]
    assert [part.stopped for part in parts] == ["elsewhere", "accepted", "elsewhere"]
    assert parts[1].best == 17


def test_no_part_goes_to_the_next_stage_before_the_others():
    toys = [InStages([[(n, 1.0)], [(n, 2.0)]]) for n in range(2)]
    toys[0].plan = [[(0, 1.0)]] * 3
    order = []
    for n, toy in enumerate(toys):
        toy.settle = lambda model, n=n: order.append(n) or model
    assert [item.stopped for item in together(*toys)] == ["exhausted", "exhausted"]
    assert order == [0, 1, 0, 1, 0]


def test_many_parts_share_one_time_limit():
    toys = [Toy([[(k, 1.0)] for k in range(100)], seconds=0.005) for _ in range(4)]
    started = time.perf_counter()
    parts = together(*toys, options=SearchOptions(work_limit_s=1e9, time_limit_s=0.05))
    assert time.perf_counter() - started < 2.0
    assert {part.stopped for part in parts} == {"time"}
    assert max(len(toy.scored) for toy in toys) - min(len(toy.scored) for toy in toys) <= 1


def test_work_that_was_done_together_is_not_charged_again():
    toy = Toy([[(k, 1.0)] for k in range(30)], scored=list(range(100)))
    together(toy, options=SearchOptions(work_limit_s=10.0))
    assert len(toy.scored) == 110


# --- each part as if it were alone ------------------------------------------------------------------------------------


def each(*toys, options=None, promise=lambda part: 0.0, may_go_on=lambda part: True, heard=lambda part: None):
    parts = [Search(toy) for toy in toys]
    limits = dict.fromkeys(parts, options or SearchOptions(work_limit_s=1e9))
    search_each(limits, lambda part: part.score >= 8.0, promise, may_go_on, heard)
    return parts


def test_parts_take_turns_until_one_stands_out_on_its_own():
    toys = [InStages([[(10 * n + k, 1.0)] for k in range(3)]) for n in range(3)]
    toys[1].plan[1] = [(17, 9.0)]
    toys[2].plan[0] = [(20, 7.9)]  # does not lead its own part, and is no rival
    parts = each(*toys)
    assert [len(toy.scored) for toy in toys] == [2, 2, 1]
    assert [part.stopped for part in parts] == ["elsewhere", "accepted", "elsewhere"]


def test_a_small_map_does_not_wait_for_large_ones():
    """A round of a large map does more work; the small one, searched to the end meanwhile, has the answer."""
    large = Toy([[(100 * n + k, 1.0) for k in range(10)] for n in range(1, 9)])
    small = Toy([[(1, 1.0)], [(2, 1.0)], [(3, 9.0)]])
    parts = each(large, small)
    assert (len(large.scored), len(small.scored)) == (10, 3)
    assert [part.stopped for part in parts] == ["elsewhere", "accepted"]


def test_work_is_shared_as_ten_to_the_power_of_the_promise():
    toys = [Toy([[(1000 * n + k, 1.0)] for k in range(1000)]) for n in range(3)]
    toys[2].plan[200] = [(1, 9.0)]
    promise = {id(toy): float(n > 0) for n, toy in enumerate(toys)}
    each(*toys, promise=lambda part: promise[id(part.estimator)])
    assert [len(toy.scored) for toy in toys] == pytest.approx([20, 200, 201], abs=1)


def test_a_part_that_promises_goes_on_before_others_begin():
    """Work that was done on a part before counts, too."""
    toys = [Toy([[(1000 * n + k, 1.0)] for k in range(1000)], before=1.0) for n in range(2)]
    toys[1].plan[5] = [(1, 9.0)]
    each(*toys, promise=lambda part: float(part.estimator is toys[1]))
    assert [len(toy.scored) for toy in toys] == [0, 6]


def test_a_part_does_its_next_stage_only_if_it_may():
    toys = [InStages([[(10 * n, 1.0)], [(10 * n + 1, 9.0)]]) for n in range(2)]
    parts = each(*toys, may_go_on=lambda part: part.estimator is toys[1])
    assert [toy.scored for toy in toys] == [[0], [10, 11]]
    assert [part.stopped for part in parts] == ["exhausted", "accepted"]


def test_a_later_stage_gets_a_tenth_of_the_work_and_ends_where_another_part_may_go_on():
    ahead, behind = InStages([[(1, 1.0)], *([(k, 1.0)] for k in range(2, 99))]), Toy([[(k, 1.0)] for k in range(60)])
    ahead.stages = lambda: iter([iter(ahead.plan[:1]), iter(ahead.plan[1:])])
    behind.plan[50] = [(50, 9.0)]
    parts = each(ahead, behind, may_go_on=lambda part: len(behind.scored) < 40)
    assert (len(ahead.scored), len(behind.scored)) == (pytest.approx(5, abs=1), 51)
    assert [part.stopped for part in parts] == ["exhausted", "accepted"]


def test_each_part_has_its_own_limit_of_work():
    toys = [Toy([[(100 * n + k, 1.0)] for k in range(50)]) for n in range(2)]
    toys[1].plan = toys[1].plan[:5]
    parts = each(*toys, options=SearchOptions(work_limit_s=20.0))
    assert [len(toy.scored) for toy in toys] == [20, 5]
    assert [part.stopped for part in parts] == ["work", "exhausted"]


def test_the_clock_ends_all_parts_and_each_is_heard_before_its_round():
    toys, heard = [Toy([[(k, 1.0)] for k in range(100)], seconds=0.03) for _ in range(3)], []
    parts = each(*toys, options=SearchOptions(time_limit_s=0.05), heard=heard.append)
    assert {part.stopped for part in parts} == {"time"}
    assert len(heard) == sum(len(toy.scored) for toy in toys) < 9
