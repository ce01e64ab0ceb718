// Thrust's iterator over some elements of an array in an order of their own.
#pragma once

namespace thrust {

template <class Elements, class Order>
struct permutation_iterator {
    Elements elements;
    Order order;

    auto& operator[](int k) const { return elements[order[k]]; }
};

template <class Elements, class Order>
permutation_iterator<Elements, Order> make_permutation_iterator(Elements elements, Order order) {
    return {elements, order};
}

}  // namespace thrust
