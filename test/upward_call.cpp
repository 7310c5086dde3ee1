// SPDX-License-Identifier: Apache-2.0
/// A call of a function of the layer stereo, for the tests layers_link_*: with the layers below
/// alone it must not link.
#include <string>

namespace omnister::sweep {
std::string simdName();
}

std::string upwardCall() { return omnister::sweep::simdName(); }
