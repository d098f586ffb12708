"""Members that are no plain files, or packed in a way that is not read."""

import stat
import tarfile
import zipfile

import pytest

from .unpacking import special, tarred, zip_entry, zipped


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE])
def test_links_in_tar(place, kind):
    assert place.refused(special(kind))[0] == "archive-link"


@pytest.mark.parametrize("kind", [tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.FIFOTYPE, b"Z"])
def test_devices_in_tar(place, kind):
    assert place.refused(special(kind))[0] == "archive-device"


def test_links_and_devices_in_zip(place):
    assert place.refused(zip_entry("log/link", stat.S_IFLNK | 0o777))[0] == "archive-link"
    assert place.refused(zip_entry("log/pipe", stat.S_IFIFO | 0o644))[0] == "archive-device"


def test_sparse_files(place):
    assert place.refused(special(tarfile.GNUTYPE_SPARSE))[0] == "archive-sparse"

    def add(archive: tarfile.TarFile) -> None:
        info = tarfile.TarInfo("log/sparse")
        info.pax_headers = {"GNU.sparse.major": "1", "GNU.sparse.realsize": str(1 << 50)}
        archive.addfile(info)

    assert place.refused(tarred(add))[0] == "archive-sparse"


def test_encrypted_zip(place):
    content = bytearray(zipped({"log/a": b"1"}))
    content[6] |= 1  # flag bit 0 of the local header, and of the directory's entry
    content[content.find(b"PK\x01\x02") + 8] |= 1
    assert place.refused(bytes(content))[0] == "encrypted-archive"


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_zip_compressed_in_an_uncommon_way(place, method):
    assert place.refused(zipped(method=method))[0] == "unknown-compression"
