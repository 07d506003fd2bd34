"""Cache entries that another user may have written are not used, and hold nothing up."""

import os
import shutil
import stat
import warnings

import cached_program
import numpy as np
import pytest
from other_users import ME, STRANGER, as_user, home_folder

from crane.codegen import cached_result, program_cache
from crane.common import file_cache
from crane.common.errors import CraneWarning

NAME, OWN, OTHERS = f"{'0' * 64}.result", b"my own", b"somebody else's"


@pytest.fixture
def home():
    with home_folder() as folder:
        yield folder


@pytest.fixture
def cache(home, monkeypatch):
    """The cache folder of the user, with one entry."""
    folder = home / "cache" / "crane" / "objects"
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "cache"))
    monkeypatch.setattr(file_cache, "cache_folder", lambda: folder)
    as_user(ME, file_cache.write_entry, NAME, OWN)
    as_user(ME, found, OWN)
    return folder


def found(wanted, message=None):
    """Check what this user reads, and the warning."""
    with warnings.catch_warnings(record=True, action="always", category=CraneWarning) as caught:
        assert file_cache.read_entry(NAME) == wanted
    assert (message is None) == (not caught), [str(x.message) for x in caught]
    assert message is None or message in str(caught[0].message)


def made_anew():
    """Check that an entry is of no use, and is then replaced."""
    found(None)
    file_cache.write_entry(NAME, OWN)
    found(OWN)
    status = os.lstat(file_cache.cache_folder() / NAME)
    assert stat.S_ISREG(status.st_mode) and stat.S_IMODE(status.st_mode) == 0o600


def whole(content):
    """A file with the right digest."""
    return file_cache._content_digest(NAME, content) + content


def of_a_stranger(path):
    path.write_bytes(whole(OTHERS))
    os.chown(path, STRANGER, STRANGER)
    path.chmod(0o666)


def shared_with_others(path):
    path.write_bytes(whole(OTHERS))
    os.chown(path, ME, ME)
    path.chmod(0o606)


def shared_with_a_group(path):
    shared_with_others(path)
    path.chmod(0o660)


def link_to_an_entry(path):
    of_a_stranger(path.parent.parent / "elsewhere")
    path.symlink_to(path.parent.parent / "elsewhere")


def link_to_my_own(path):
    path.with_name("copy").write_bytes(whole(OTHERS))
    os.chown(path.with_name("copy"), ME, ME)
    path.symlink_to("copy")


def endless(path):
    path.write_bytes(b"")
    os.truncate(path, file_cache.MAX_CACHE_SIZE + 1)


PLANTED = {
    "of a stranger": of_a_stranger,
    "that others may write": shared_with_others,
    "that a group may write": shared_with_a_group,
    "a pipe": os.mkfifo,
    "an endless device": lambda path: path.symlink_to("/dev/zero"),
    "a link": link_to_an_entry,
    "a link to my own": link_to_my_own,
    "too large": endless,
}


@pytest.mark.parametrize("what", PLANTED)
def test_an_entry_that_is_not_mine_is_made_anew(cache, what):
    (cache / NAME).unlink()
    PLANTED[what](cache / NAME)
    as_user(ME, made_anew)


def test_a_strangers_folder_that_leads_into_mine_is_not_used(home, cache, monkeypatch):
    """Both the folder above and a link in the way; the target itself is mine."""
    as_user(STRANGER, (home.parent / "crane").mkdir)
    as_user(STRANGER, (home.parent / "crane" / "objects").symlink_to, cache)
    (home.parent / "link").symlink_to(home / "cache")
    os.chown(home.parent / "link", STRANGER, STRANGER, follow_symlinks=False)
    for folder in (home.parent / "crane" / "objects", home.parent / "link/crane/objects"):
        monkeypatch.setattr(file_cache, "cache_folder", lambda folder=folder: folder)
        as_user(ME, found, None, "because other users can change")
        as_user(ME, os.stat, folder / NAME)  # it could be read
        as_user(ME, made_in_vain, folder)


def made_in_vain(folder):
    before = sorted(folder.iterdir())
    with warnings.catch_warnings(action="ignore"):
        file_cache.write_entry(f"{'1' * 64}.result", OWN)
    assert sorted(folder.iterdir()) == before


def test_folders_on_the_way_that_others_may_change(home, cache):
    for folder in (cache, cache.parent, home):
        mode = stat.S_IMODE(folder.stat().st_mode)
        for more in (0o020, 0o002):
            folder.chmod(mode | more)
            as_user(ME, found, None, f"can change {folder},")
        folder.chmod(0o755)
        os.chown(folder, STRANGER, STRANGER)
        as_user(ME, found, None, f"can change {folder},")
        os.chown(folder, ME, ME)
        folder.chmod(mode)
    cache.chmod(0o1777)  # others could add entries
    as_user(ME, found, None, f"can change {cache},")


def test_my_own_links_and_those_of_root_are_followed(home, cache, monkeypatch):
    as_user(ME, (home / "there").symlink_to, "cache/../cache")
    (home.parent / "mine").symlink_to(home)
    for folder in (home / "there/crane/objects", home.parent / "mine/there/crane/objects"):
        monkeypatch.setattr(file_cache, "cache_folder", lambda folder=folder: folder)
        as_user(ME, found, OWN)
    as_user(ME, (home / "loop").symlink_to, home / "loop")
    monkeypatch.setattr(file_cache, "cache_folder", lambda: home / "loop")
    as_user(ME, found, None, "can change")


def test_folders_are_made_for_this_user_alone_whatever_the_mask(home, cache):
    def write():
        os.umask(0)
        shutil.rmtree(home / "cache")
        made_anew()

    as_user(ME, write)
    for folder in (cache, *cache.parents[:2]):
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_machine_code_of_a_stranger_is_not_executed(place, home, cache):
    """Its digest is right and its name that of the program, which would compute something else."""
    computed = home / "computed"
    cached_program.toy(5.0)  # imports what another user may not read

    def compute(factor):
        built = []
        value = cached_program.value(cached_program.toy(factor, built))
        computed.write_text(f"{len(built)} {value!r}")

    def value():
        count, number = computed.read_text().split()
        return int(count), float(number)

    for factor in (4.0, 3.0):
        as_user(ME, compute, factor)
        assert value() == (1, pytest.approx(cached_program.wanted(factor)))
        if factor == 4.0:
            code = next(cache.glob("*.code")).read_bytes()[file_cache._DIGEST_SIZE :]
            for file in cache.glob("*.[cn]o*"):
                file.unlink()
    (entry,) = cache.glob("*.code")
    entry.write_bytes(file_cache._content_digest(entry.name, code) + code)
    as_user(ME, compute, 3.0)
    assert value() == (0, pytest.approx(cached_program.wanted(4.0)))  # it is code that runs
    os.chown(entry, STRANGER, STRANGER)
    entry.chmod(0o666)
    for built in (1, 0):
        as_user(ME, compute, 3.0)
        assert value() == (built, pytest.approx(cached_program.wanted(3.0)))


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"12345678{", b"null", b'{"functions": {"f": 1}}']
)
def test_a_record_that_cannot_be_read_is_made_anew(place, content):
    """As when a later version has written it."""
    name = program_cache.cache_entry_name(("toy", 3.0))
    file_cache.write_entry(name, content)
    for count in (1, 0):
        built = []
        value = cached_program.value(cached_program.toy(3.0, built))
        assert value == pytest.approx(cached_program.wanted(3.0)) and len(built) == count


@pytest.mark.parametrize(
    "head", [b'{"of": [], "state": {}}', b'{"array": ["x", [1], 0]}', b"[[[", b"\xff"]
)
def test_a_result_that_cannot_be_read_is_made_anew(place, head):
    cached_result("what", lambda: np.ones(2), "no.such.module", ())
    (file,) = place.glob("[!.]*.result")
    file_cache.write_entry(file.name, len(head).to_bytes(8, "little") + head)
    for _ in range(2):
        again = cached_result("what", lambda: np.ones(2), "no.such.module", ())
        assert (again == 1.0).all()
    assert file.read_bytes()[file_cache._DIGEST_SIZE + 8 :] != head
