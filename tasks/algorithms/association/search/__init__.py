"""The search for objects in a window: seeds, growth, and the decision between hypotheses."""
