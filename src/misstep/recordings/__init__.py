"""What happens to a recording between reading and writing: columns, actions, outcomes, one clock.

Each stage takes an episode and returns an episode, block by block, see `misstep.formats.format`;
what it infers or changes, it notes in the provenance.
"""
