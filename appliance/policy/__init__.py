"""The access policy. A `Policy` is compiled from INI text; `Policy.decide(request)` is a pure function."""
