"""Note on which topics each specification acts, and let events on the others read whole messages only.

An event reads only the fields of its pattern, so it would take a message that is cut off behind them, or too long, as
evidence. On a topic on which the specification acts this needs no check: subscribers reject what they cannot read.
"""

from dataclasses import replace

import msgspec

from rosmop.check.acted_topics import acted_topics, published_topics
from rosmop.check.locate import FieldLocator, MessageCursor
from rosmop.form import nodes
from rosmop.form.compiled import Compiled, EventCode
from rosmop.form.sites import Site, Symbols
from rosmop.run.guards import guards_of


class _EndSymbols(Symbols):
    """Names that no other part of the compiler makes."""

    def fresh(self, prefix: str) -> str:
        return super().fresh(f"{prefix}end")


def with_observed_topics(compiled: Compiled) -> Compiled:
    """Return the compiled specifications with `acts_on`, and with a check of the length of observed messages.

    Only the events on which an action depends get this check.
    """
    functions, symbols = dict(compiled.functions), _EndSymbols()
    symbols.sites = [*compiled.sites]
    published = published_topics(functions.values())
    codes = tuple(
        replace(one, acts_on=acted_topics(one, functions, published.get(one.context, ())))
        for one in compiled.specifications
    )
    compiled = replace(compiled, specifications=codes)
    observing = guards_of(compiled).observing
    for code in codes:
        symbols.begin(code.name)
        for event in code.events:
            if event.function in observing:
                name = event.key or event.function
                functions[name] = _checked(functions[name], event, compiled, symbols)
    return replace(compiled, functions=functions, sites=symbols.sites)


def _checked(
    function: nodes.Function, event: EventCode, compiled: Compiled, symbols: Symbols
) -> nodes.Function:
    found: list[nodes.Statement] = []
    site = symbols.site(Site(event.position))
    layout = compiled.messages.definitions.layout(event.type or "")
    end = MessageCursor(FieldLocator(symbols, found, site), layout, nodes.Spot(None, 0)).end()
    found.append(nodes.Ends(site, end))
    happens = None if function.happens is None else function.happens + len(found)
    return msgspec.structs.replace(function, body=(*found, *function.body), happens=happens)
