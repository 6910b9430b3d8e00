"""Translate the intermediate form of an event (`form/nodes.py`) to terms of z3, as `run/interpreter.py` runs it.

The interpreter also measures the values of a specification once for each megabyte that it allocates; this is left out.
"""

from collections.abc import Mapping
from types import MappingProxyType

from rosmop.form import nodes
from rosmop.prove import expression_terms, message_terms, statement_terms
from rosmop.prove.event_terms import EventTerms, ExpressionRow, StatementRow

STATEMENTS: Mapping[type[nodes.FormNode], StatementRow] = MappingProxyType(
    {
        nodes.Evaluate: statement_terms.evaluate,
        nodes.If: statement_terms.branch,
        nodes.Loop: statement_terms.loop,
        nodes.ForEach: statement_terms.left_loop,
        nodes.Break: statement_terms.break_loop,
        nodes.Continue: statement_terms.continue_loop,
        nodes.Select: statement_terms.select,
        nodes.Return: statement_terms.return_from,
        nodes.Leave: statement_terms.leave,
        nodes.Charge: statement_terms.charge,
        nodes.Allocate: statement_terms.allocate,
        nodes.LimitDepth: nodes.Left("recursion"),
        nodes.Drop: statement_terms.drop,
        nodes.Reset: nodes.Left("a reset"),
        nodes.StopMessage: statement_terms.stop,
        nodes.Publish: nodes.Left("a message to publish"),
        nodes.AfterText: message_terms.after_text,
        nodes.Count: message_terms.count_elements,
        nodes.AfterElements: message_terms.after_elements,
        nodes.Skip: statement_terms.left_loop,
        nodes.NotPast: statement_terms.not_past,
        nodes.Ends: message_terms.ends_at,
        nodes.ReadNumbers: message_terms.read_numbers,
        nodes.ReadValue: message_terms.read_value,
        nodes.Require: statement_terms.require,
        nodes.Pending: statement_terms.pending,
        nodes.WriteBack: message_terms.write_back,
    }
)
EXPRESSIONS: Mapping[type[nodes.FormNode], ExpressionRow] = MappingProxyType(
    {
        nodes.Literal: expression_terms.literal,
        nodes.Read: expression_terms.read,
        nodes.Assign: expression_terms.assign,
        nodes.Convert: expression_terms.convert,
        nodes.Arithmetic: expression_terms.arithmetic,
        nodes.Unary: expression_terms.unary,
        nodes.Moment: expression_terms.moment,
        nodes.MomentOf: expression_terms.moment_of,
        nodes.Compare: expression_terms.compare,
        nodes.CompareTexts: expression_terms.compare_texts,
        nodes.Logical: expression_terms.logical,
        nodes.Not: expression_terms.negation,
        nodes.Conditional: expression_terms.conditional,
        nodes.Sequence: expression_terms.sequence,
        nodes.Discard: expression_terms.discard,
        nodes.Item: expression_terms.item,
        nodes.Vector: nodes.Left("an array that is built"),
        nodes.Zero: expression_terms.zero,
        nodes.Copy: expression_terms.copied,
        nodes.Recast: nodes.Left("a converted array of bytes"),
        nodes.OfType: nodes.Left("a function for values of any type"),
        nodes.Call: expression_terms.call,
        nodes.Accumulate: statement_terms.left_loop,
        nodes.Invoke: expression_terms.invoke,
        nodes.Format: nodes.Left("formatted text"),
        nodes.Join: nodes.Left("joined strings"),
        nodes.Log: statement_terms.log,
        nodes.Throttle: expression_terms.throttle,
        nodes.Now: expression_terms.now,
        nodes.SenderName: expression_terms.sender,
        nodes.Altered: expression_terms.altered,
        nodes.Whole: nodes.Left("MESSAGE"),
    }
)


class FormTerms(EventTerms):
    """Translates one event on a topic."""

    statements = STATEMENTS
    expressions = EXPRESSIONS
