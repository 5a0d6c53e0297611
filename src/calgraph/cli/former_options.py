"""Options of earlier versions, which are settings now: they are accepted with the same meaning, and not shown."""

from collections.abc import Iterator, Mapping, Sequence

_FORMER: Mapping[str, Mapping[str, str]] = {
    "calibrate": {
        "--average": "average",
        "--feature": "feature",
        "--filter": "keep",
        "--start": "start",
        "--tags": "tags",
        "--weights": "weights",
    },
    "solve": {"--filter": "keep"},
}
"""By command, the key below ``published`` of each option with a value."""
_FLAGS = {"--icp": "published.icp=true", "--no-icp": "published.icp=false"}
_ESTIMATORS = ("bundle", "hypergraph", "averaging")
"""Values of --estimator that name the last step alone."""


def translate_former_options(command: str, arguments: Sequence[str]) -> list[str]:
    """The arguments of a command, with each former option replaced by ``--set published.KEY=VALUE``."""
    return list(_translate(arguments, _FORMER[command], command)) if command in _FORMER else list(arguments)


def _translate(arguments: Sequence[str], keys: Mapping[str, str], command: str) -> Iterator[str]:
    rest = iter(arguments)
    for argument in rest:
        if argument == "--":
            yield from (argument, *rest)
            return
        option, equals, value = argument.partition("=")
        if command == "calibrate" and argument in _FLAGS:
            yield from ("--set", _FLAGS[argument])
        elif option in keys or option == "--estimator":
            stated = value if equals else next(rest, None)
            if stated is None:  # which the parser reports
                yield "--set" if option in keys else option
            elif option in keys:
                yield from ("--set", f"published.{keys[option]}={stated}")
            elif stated in _ESTIMATORS:
                yield from ("--set", f"published.estimator={stated}")
            else:
                yield from (option, stated)
        else:
            yield argument
