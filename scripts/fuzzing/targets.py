"""All targets, by their names."""

from fuzzing import estimators, messages, readers, settings

_ALL = (*readers.TARGETS, *settings.TARGETS, *messages.TARGETS, *estimators.TARGETS)

TARGETS = {target.name: target for target in _ALL}
