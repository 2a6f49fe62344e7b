"""Trial of the diagnosis on effects of no catalogue, by a small bench of its own that shares no formula with the
package."""
