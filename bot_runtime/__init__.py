"""What runs inside a frame: bundles, policies, contexts, budgets and the Bots façade. Never imports torch."""
