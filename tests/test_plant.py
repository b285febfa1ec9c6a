"""The list of planted faults is true: each stands in the source once, is no slip of syntax, and its tests are there."""

import pytest
from plant import FAULTS, ROOT, Fault


@pytest.mark.parametrize("fault", FAULTS, ids=lambda one: one.name)
def test_a_fault_is_in_the_source_once(fault: Fault) -> None:
    compile(fault.insert(ROOT), fault.file, "exec")
    assert fault.after != fault.before
    assert fault.tests
    for test in fault.tests:
        file, _, function = test.partition("::")
        assert f"def {function}" in (ROOT / file).read_text("utf-8")
