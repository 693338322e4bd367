# SPDX-License-Identifier: Apache-2.0
"""A fake that is not called like the real thing is found out."""
import pytest
from fakes import called_like, compressed_message, image_message, stands_in_for


class Real:
    def __init__(self, size, quiet=False):
        pass

    def push(self, frame, final=True):
        pass


def test_a_fake_that_is_called_alike_passes():
    @stands_in_for(Real)
    class Fake:
        def __init__(self, size, quiet=True):
            pass

        def push(self, frame):  # nobody needs to say final
            pass

        def _own(self):
            pass
    assert Fake


@pytest.mark.parametrize('push', [
    lambda self: None, lambda self, image, final=True: None, lambda self, frame, final: None,
    lambda self, frame, final=True, other=None: None, lambda self, frame, *, final=True: None,
    lambda self, **anything: None])
def test_another_signature_is_found_out(push):
    with pytest.raises(TypeError, match='is not called like'):
        stands_in_for(Real)(type('Fake', (), {'push': push}))
    with pytest.raises(TypeError, match='is not called like'):
        called_like(Real.push)(push)


def test_a_method_that_the_real_one_has_not_is_found_out():
    with pytest.raises(AttributeError, match='pull'):
        stands_in_for(Real)(type('Fake', (), {'pull': lambda self: None}))


def test_messages_have_the_fields_of_ros():
    assert compressed_message(format='jpeg', data=b'').format == 'jpeg'
    for make, fields in ((image_message, {'encoding': 'mono8'}),
                         (compressed_message, {'format': 'jpeg', 'data': b'', 'size': 3})):
        with pytest.raises(TypeError):
            make(**fields)
