"""What the gate and repeated requests learn of each operation from the OpenAPI document."""

import pytest

from l3ps_api.app import create_app
from l3ps_api.operations import Operations, operations_of
from l3ps_platform.settings import Settings


@pytest.fixture(scope="module")
def operations(tmp_path_factory) -> Operations:
    return operations_of(create_app(Settings(data_dir=tmp_path_factory.mktemp("data"))))


def test_head_takes_the_query_that_get_takes(operations):
    for path in ("/v1/labels.tar", "/v1/jobs/job_1/labels.tar"):
        found = operations.at(path)
        assert found["GET"].query and found["HEAD"].query == found["GET"].query


@pytest.mark.parametrize(
    "path",
    ["/v1/jobs", "/v1/jobs/job_1/retry", "/v1/uploads/upl_1/complete", "/v1/models/train", "/v1/webhooks/whk_1/rotate"],
)
def test_what_is_answered_with_a_resource_can_be_answered_with_it_again(operations, path):
    assert operations.at(path)["POST"].resource


@pytest.mark.parametrize("path", ["/v1/notifications/s3", "/v1/uploads/upl_1/parts", "/v1/webhooks/whk_1/replay"])
def test_a_count_or_a_list_of_urls_is_no_resource(operations, path):
    """A drive or job that a notification makes on the way would be answered in its place."""
    assert not operations.at(path)["POST"].resource


def test_a_collection_is_known_by_its_members(operations):
    assert {"jobs", "keys", "uploads", "webhooks"} <= operations.kinds
